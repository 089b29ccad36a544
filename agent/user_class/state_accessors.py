"""Names for the entries of a state or a measurement, for controllers of the user."""

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.parameters import System
from transport.model.physics.rotations import rotation
from transport.protocol.wire.messages import Measurement, Plan

Source = Array | Measurement  # a state of the team, (12 + 12 N,), or a measurement of own UAVs


class Layout:
    """Access by name to states of the team, (12 + 12 N,), and to measurements.

    UAVs are numbered from 0. With `plant.sensors = "vehicle"` a measurement has neither payload nor
    rods: those methods raise LookupError.
    """

    __slots__ = ()

    system: System

    def payload_position(self, source: Source) -> Array:
        """Return r0, (3,), inertial frame with z down, m."""
        return self._payload(source)[state.R0]

    def payload_velocity(self, source: Source) -> Array:
        """Return v0, (3,), payload frame, m/s."""
        return self._payload(source)[state.V0]

    def payload_attitude(self, source: Source) -> Array:
        """Return roll, pitch and yaw of the payload, (3,), rad."""
        return self._payload(source)[state.THETA0]

    def payload_rate(self, source: Source) -> Array:
        """Return omega0, (3,), payload frame, rad/s."""
        return self._payload(source)[state.OMEGA0]

    def rod_direction(self, uav: int, source: Source) -> Array:
        """Return e_i, (3,), from the UAV to its attachment point, payload frame, unit length."""
        return self._rod(uav, source)[state.E]

    def rod_rate(self, uav: int, source: Source) -> Array:
        """Return Omega_i, the angular velocity of the rod, (3,), payload frame, rad/s."""
        return self._rod(uav, source)[state.ROD_RATE]

    def attitude(self, uav: int, source: Source) -> Array:
        """Return roll, pitch and yaw of a UAV, (3,), rad."""
        return self._uav(uav, source)[state.THETA]

    def body_rate(self, uav: int, source: Source) -> Array:
        """Return the angular velocity of a UAV, (3,), its body frame, rad/s."""
        return self._uav(uav, source)[state.OMEGA]

    def position(self, uav: int, source: Source) -> Array:
        """Return r_i, the centre of mass of a UAV, (3,), inertial frame with z down, m.

        r_i = r0 + R(Theta0) (rho_i - l_i e_i), or as measured by the UAV's own sensors.
        Source: paper, section II.
        """
        block = self._uav(uav, source)
        if len(block) == state.SENSED:
            return block[state.POSITION]
        body = self.system.uavs[uav]
        payload = self._payload(source)
        R_IP = rotation(payload[state.THETA0])
        r_P = body.rho - body.rod_length * block[state.E]
        return np.asarray(payload[state.R0] + R_IP @ r_P)

    def velocity(self, uav: int, source: Source) -> Array:
        """Return the velocity of the centre of mass of a UAV, (3,), inertial frame, m/s.

        As measured by the UAV's own sensors, or from the states: with the swing of the rod,
        l_i Omega_i x e_i. Source: docs/equations.md (39).
        """
        block = self._uav(uav, source)
        if len(block) == state.SENSED:
            return block[state.VELOCITY]
        body = self.system.uavs[uav]
        payload = self._payload(source)
        R_IP = rotation(payload[state.THETA0])
        swing = np.cross(block[state.ROD_RATE], body.rod_length * block[state.E])
        turning = np.cross(payload[state.OMEGA0], body.rho)
        return np.asarray(R_IP @ (payload[state.V0] + turning - swing))

    def write(self, x: Array, message: Measurement | Plan) -> None:
        """Write the states that a measurement or another agent's plan has into a state, in place.

        They are those at the tick of the message. Raises: LookupError: it has no states.
        """
        if message.uav_states.shape[1] != state.PER_UAV:
            raise LookupError(
                "with plant.sensors = 'vehicle' no message has states: use run.estimator()"
            )
        if isinstance(message, Measurement):
            x[: state.PAYLOAD] = message.payload
        for uav, block in zip(message.uavs, message.uav_states, strict=True):
            x[state.uav_slice(uav - 1)] = block

    def _payload(self, source: Source) -> Array:
        """Return the states of the payload, (12,)."""
        values = source.payload if isinstance(source, Measurement) else source[: state.PAYLOAD]
        if not len(values):
            raise LookupError("no sensor of a vehicle sees the payload: use run.estimator()")
        return values

    def _rod(self, uav: int, source: Source) -> Array:
        """Return the states of a UAV with its rod, (12,)."""
        block = self._uav(uav, source)
        if len(block) != state.PER_UAV:
            raise LookupError("no sensor of a vehicle sees the rods: use run.estimator()")
        return block

    def _uav(self, uav: int, source: Source) -> Array:
        """Return the states of a UAV, (12,), or the measurements of its sensors, (15,)."""
        if not isinstance(source, Measurement):
            return source[state.uav_slice(uav)]
        if uav + 1 not in source.uavs:
            own = [number - 1 for number in source.uavs]
            raise LookupError(f"expected one of the own UAVs {own}, counted from 0, got {uav}")
        block: Array = source.uav_states[source.uavs.index(uav + 1)]
        return block
