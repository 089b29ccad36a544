"""The fail-safe of a UAV whose plan has run out.

Hover thrust, and level attitude or the way along the reference.
"""

from collections.abc import Collection

import numpy as np

from transport.model import flat, state
from transport.model.arrays import Array, rows
from transport.model.flat import Track
from transport.model.hover import failed_hover, with_released
from transport.model.identity import digest
from transport.model.parameters import ParameterError, System
from transport.model.rotations import rotation

# Attitude loop on moments: slow enough for the moment limits of small quadrotors, faster than the
# pendulum of a rod.
_FREQUENCY_RAD_S = 6.0
_DAMPING = 0.8

# Attitude loop around an inner loop on body rates, as usual autopilots: critical damping at a
# quarter of the inner loop's gain, 1/s, and the largest gain, 1/s.
_CRITICAL = 0.25
_LARGEST_GAIN = 6.0

# Loop on the horizontal position: as fast as the pendulum of a rod.
_FOLLOWING_RAD_S = 1.5
_FOLLOWING_DAMPING = 1.0
_STEEPEST = 0.2  # largest roll or pitch that it asks for, rad


class FailSafe:
    """The fail-safes of all UAVs: hover thrusts u_hover, (4 N,), or the inputs of a flat track.

    They follow the states X_ref, (K, n), the last one held, by measured position and velocity;
    without them they keep level.
    """

    def __init__(
        self, system: System, u_hover: Array, X_ref: Array | None = None, track: Track | None = None
    ) -> None:
        self.u_hover = u_hover
        self.track = track
        self._X_ref = X_ref
        self._system = system
        self._gains = [_attitude_gain(system, uav) for uav in range(system.N)]

    @property
    def follows(self) -> bool:
        """True if UAVs follow the reference, and do not only keep level."""
        return self._X_ref is not None

    @property
    def key(self) -> bytes:
        """Digest of the numbers that the inputs follow from."""
        by_track = None if self.track is None else self.track.key
        return digest(self._system, self.u_hover, self._X_ref, by_track)

    def of_team(self, off: Collection[int], released: Collection[int]) -> "FailSafe":
        """Return the fail-safe whose thrusts hold the payload without UAVs off or released.

        The same one if that team has no hover. Source: docs/equations.md (51).
        """
        if not off:
            return self
        try:
            hover = failed_hover(self._system, off, released)
        except ParameterError:
            return self

        # Inputs of UAVs without motors have no effect; a thrust of zero would have no attitude to
        # tilt it.
        running = np.repeat([uav not in off for uav in range(self._system.N)], state.INPUTS)
        u_hover = np.where(running, hover.u, self.u_hover)

        track = self.track
        X_ref = self._X_ref
        if track is not None and released:
            system = with_released(self._system, released)
            track = flat.track(system, hover, track.paths, track.first, released)
            if X_ref is not None:
                X_ref = np.concatenate([X_ref[: track.first], track.X])
        return FailSafe(self._system, u_hover, X_ref, track)

    def gain(self, uav: int) -> Array:
        """Return the linearised feedback from the state to a UAV's inputs, (4, n).

        Source: docs/equations.md (31), (31a), (45), (58).
        """
        n = self._system.n
        own = state.uav_slice(uav)
        gain = np.zeros((state.INPUTS, n))
        gain[:, own] = self._gains[uav]
        if self._X_ref is None:
            return gain

        # Derivatives at hover of r = r0 + R0 (rho - l e) and of its rate, (3, n) each.
        rho = self._system.uavs[uav].rho
        rod = np.array([0.0, 0.0, self._system.uavs[uav].rod_length])
        position = np.zeros((3, n))
        position[:, state.R0] = np.eye(3)
        position[:, state.THETA0] = np.cross(np.eye(3), rho - rod).T
        position[:, own][:, state.E] = -rod[2] * np.eye(3)

        velocity = np.zeros((3, n))
        velocity[:, state.V0] = np.eye(3)
        velocity[:, state.OMEGA0] = np.cross(np.eye(3), rho).T
        velocity[:, own][:, state.ROD_RATE] = -np.cross(np.eye(3), rod).T
        return gain + self._gains[uav][:, state.THETA] @ -self._wanted(uav, position, velocity)

    def inputs(self, uav: int, x: Array, tick: int) -> Array:
        """Return the inputs of one UAV, 0-based, at a state at t_k, (n,), before limits, (4,).

        Source: docs/equations.md (31), (31a), (58).
        """
        own = x[state.uav_slice(uav)].copy()
        only_thrust = np.array([1.0, 0.0, 0.0, 0.0])
        at_rest: Array = self.u_hover[state.input_slice(uav)] * only_thrust
        if self._X_ref is None:
            return at_rest + self._gains[uav] @ own

        # Roll and pitch that lead back to the reference, in the UAV's own heading.
        position, velocity = self._motion(uav, x)
        last = len(self._X_ref) - 1
        position_ref, velocity_ref = self._motion(uav, self._X_ref[min(tick, last)])
        to_heading = rotation(np.array([0.0, 0.0, own[state.THETA][2]])).T
        wanted = self._wanted(
            uav, to_heading @ (position - position_ref), to_heading @ (velocity - velocity_ref)
        )
        own[state.THETA] -= np.clip(wanted, -_STEEPEST, _STEEPEST)

        if self.track is not None:
            row = rows(tick - self.track.first, 1, len(self.track.U))
            at_rest = self.track.U[row][0, state.input_slice(uav)]
            own = own - self.track.X[row][0, state.uav_slice(uav)]
        return at_rest + self._gains[uav] @ own

    def _motion(self, uav: int, x: Array) -> tuple[Array, Array]:
        """Return position and velocity of a UAV, inertial frame, m and m/s.

        r = r0 + R0 (rho - l e),  r' = R0 (v0 + omega0 x rho - Omega x l e)
        Source: docs/equations.md (1), (39).
        """
        R0 = rotation(x[state.THETA0])
        block = x[state.uav_slice(uav)]
        rho = self._system.uavs[uav].rho
        rod = self._system.uavs[uav].rod_length * block[state.E]
        turning = np.cross(x[state.OMEGA0], rho) - np.cross(block[state.ROD_RATE], rod)
        return x[state.R0] + R0 @ (rho - rod), R0 @ (x[state.V0] + turning)

    def _wanted(self, uav: int, position: Array, velocity: Array) -> Array:
        """Return roll, pitch and 0, (3, ...), by deviations in axes of the heading, (31a)."""
        stiffness = _FOLLOWING_RAD_S**2
        damping = 2.0 * _FOLLOWING_DAMPING * _FOLLOWING_RAD_S
        lift = self.u_hover[state.input_slice(uav)][0]
        pull = self._system.uavs[uav].mass / lift * (stiffness * position + damping * velocity)
        return np.stack([-pull[1], pull[0], np.zeros_like(pull[0])])


def _attitude_gain(system: System, uav: int) -> Array:
    """Return the feedback on a UAV's own state that levels it, (4, 12): (31), (58)."""
    level = np.diag([1.0, 1.0, 0.0])  # the heading is free
    inertia = system.uavs[uav].inertia
    gain = np.zeros((state.INPUTS, state.PER_UAV))
    if system.rate_gains is not None:
        by_axis = np.minimum(_CRITICAL * system.rate_gains, _LARGEST_GAIN)
        gain[1:, state.THETA] = -np.diag(by_axis) @ level
    else:
        gain[1:, state.THETA] = -(_FREQUENCY_RAD_S**2) * inertia @ level
        gain[1:, state.OMEGA] = -2.0 * _DAMPING * _FREQUENCY_RAD_S * inertia
    return gain
