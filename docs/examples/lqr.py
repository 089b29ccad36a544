"""A linear-quadratic regulator about hover.

Every agent has the gain of the team and applies its own rows of it.

In the folder of this file: transport run resilient --set agents.controller=lqr:LQR, and with
--set 'agents.owned=[[1,2,3,4]]' a single agent that measures the whole state.
"""

import numpy as np
from scipy.linalg import expm, solve_discrete_are


class LQR:
    """Controller of the UAVs that an agent owns, from the states of all."""

    version = "1"

    def start(self, run):
        """Compute the gain."""
        self.run, n, m = run, len(run.x_hover), len(run.u_hover)
        linear = run.model.linearise(run.x_hover, run.u_hover)
        # Zero-order hold.
        held = expm(run.period_s * np.block([[linear.A_c, linear.B_c], [np.zeros((m, n + m))]]))
        # The rods hang: the third entries of their unit direction and of its rate cannot change.
        self.free = [i for i in range(n) if i < 12 or (i - 12) % 12 not in (2, 5)]
        A, B = held[np.ix_(self.free, self.free)], held[self.free, n:]
        C = linear.C[:, self.free]  # positions of the UAVs, attitude of the payload, yaw rates
        R = np.diag(np.tile([0.01, 1.0, 1.0, 1.0], run.system.N))
        P = solve_discrete_are(A, B, C.T @ C + 1e-3 * np.eye(len(A)), R)
        self.K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        self.x = run.reference(0)

    def step(self, measurement, messages):
        """Return one row of inputs from the newest states."""
        run = self.run
        self.update(measurement, messages)
        self.inputs = run.u_hover - self.K @ (self.x - self.goal())[self.free]
        return self.inputs.reshape(-1, 4)[list(run.owned)].ravel()

    def goal(self):
        """Return the reference state at the tick at which the inputs act."""
        return self.run.reference(self.run.tick + self.run.delay)

    def update(self, measurement, messages):
        """Take in the newest states; those of the others are at least one period late."""
        self.x[:12] = measurement.payload
        for known in (*messages, measurement):
            for uav, state in zip(known.uavs, known.uav_states, strict=True):
                self.x[12 * uav : 12 * uav + 12] = state  # UAVs count from 1 in messages

    def stop(self):
        """Nothing is open."""
