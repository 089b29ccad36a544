"""A PID controller of each UAV's position, by its attitude, by its moments.

It uses nothing of the other agents.

In the folder of this file: transport run resilient --set agents.controller=pid:PID
"""

import numpy as np

from transport.model.physics.rotations import rotation

GAINS = 4.0, 0.4, 4.0  # of the position error, its integral and its derivative: 1/s^2, 1/s^3, 1/s
STIFFNESS, DAMPING = 100.0, 16.0  # of the attitude: 1/s^2, 1/s


class PID:
    """Controller of the UAVs that an agent owns, each by itself."""

    version = "1"

    def start(self, run):
        """Keep the description of the run; there are no errors yet."""
        self.run, self.before, self.integral = run, {}, np.zeros((run.system.N, 3))

    def step(self, measurement, messages):  # noqa: ARG002
        """Return one row of inputs, held until the next, and the errors for the log."""
        run, inputs, data = self.run, [], {}
        wanted = run.reference(measurement.tick)
        for uav, own in zip(run.owned, measurement.uav_states, strict=True):
            error = self.position(uav, wanted, wanted[12 * uav + 12 :]) - self.position(
                uav, measurement.payload, own
            )
            rate = (error - self.before.get(uav, error)) / run.period_s
            self.before[uav] = error
            self.integral[uav] = np.clip(self.integral[uav] + error * run.period_s, -1.0, 1.0)
            inputs.append(self.inputs(uav, own, np.dot(GAINS, [error, self.integral[uav], rate])))
            data[f"error{uav + 1}_m"] = np.linalg.norm(error)
        return np.concatenate(inputs), data

    def position(self, uav, payload, own):
        """Return the position of a UAV, inertial frame, from the states of the payload, its rod and itself."""
        body = self.run.system.uavs[uav]
        return payload[:3] + rotation(payload[6:9]) @ (body.rho - body.rod_length * own[:3])

    def inputs(self, uav, own, acceleration):
        """Return thrust and moments that accelerate a UAV and its share of the payload.

        Z points down.
        """
        hover, gravity, inertia = (
            self.run.u_hover[4 * uav],
            self.run.system.gravity,
            self.run.system.uavs[uav].inertia,
        )
        turn = (
            np.array([*np.clip([acceleration[1], -acceleration[0]], -3.0, 3.0) / gravity, 0.0])
            - own[6:9]
        )
        moments = inertia @ (STIFFNESS * turn - DAMPING * own[9:12])
        return np.array([hover - hover / gravity * acceleration[2], *moments])

    def stop(self):
        """Nothing is open."""
