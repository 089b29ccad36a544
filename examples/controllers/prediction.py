"""Linear prediction of the team with some own UAVs, over one horizon.

About the present state x0 and inputs u0, over one sampling period (docs/equations.md (14)-(17)):

    dx(k+1) = A dx(k) + B du(k) + f_d,    y(k) = h(x0) + C dx(k)

The variables are the owned inputs in units of half their range, z = (u_own - u0_own) / range.
"""

import numpy as np
from scipy.linalg import expm


class Prediction:
    """Prediction for the inputs of some UAVs of a team, counted from 0."""

    def __init__(self, run, uavs):
        """Take horizon and limits from the scenario."""
        self.run = run
        self.steps = run.horizon
        self.own = np.array([4 * uav + j for uav in uavs for j in range(4)])
        self.lower = run.settings.lower(len(uavs))
        self.upper = run.settings.upper(len(uavs))
        self.range = (self.upper - self.lower) / 2.0

    def about(self, x0, u0):
        """Linearise about a state and inputs; A^j B scaled, C and f_d follow."""
        n = len(x0)
        linear = self.run.model.linearise(x0, u0)
        self.x0 = x0
        self.u0 = u0
        self.y0 = linear.y
        self.C = linear.C

        #   exp([A_c B_c f; 0] T_s) = [A B f_d; 0 I 0; 0 0 1]        (16), (17)
        generator = np.zeros((n + len(u0) + 1, n + len(u0) + 1))
        generator[:n] = np.column_stack([linear.A_c, linear.B_c, linear.f])
        held = expm(self.run.period_s * generator)[:n]
        self.A = held[:, :n]
        self.B = held[:, n:-1]
        self.f_d = held[:, -1]

    def free(self, U):
        """Return dx(1..N_p) with all inputs U, (N_p, 4 N), but the own ones held at u0."""
        dU = U - self.u0
        dU[:, self.own] = 0.0
        dx = np.zeros(len(self.A))
        states = []
        for du in dU:
            dx = self.A @ dx + self.B @ du + self.f_d
            states.append(dx)
        return np.array(states)

    def effect(self, G):
        """Return the effect of z on signals G dx(1..N_p): S(k, j) = G A^(k-j) B range, k >= j."""
        steps, m = self.steps, len(self.own)
        S = np.zeros((steps, len(G), steps, m))
        impulse = self.B[:, self.own] * self.range
        for age in range(steps):
            on_signals = G @ impulse
            for j in range(steps - age):
                S[j + age, :, j] = on_signals
            impulse = self.A @ impulse
        return S.reshape(steps * len(G), steps * m)

    def scaled(self, U):
        """Return own inputs, (N_p, 4 owned), as z, flat."""
        return ((U - self.u0[self.own]) / self.range).reshape(-1)

    def inputs(self, z):
        """Return own inputs, (N_p, 4 owned), from z."""
        return self.u0[self.own] + z.reshape(-1, len(self.own)) * self.range
