"""Linear prediction of the team and the quadratic program of some of its UAVs.

About the present state x0 and inputs u0, over one sampling period (docs/equations.md (14)-(17)):

    dx(k+1) = A dx(k) + B du(k) + f_d,    y(k) = h(x0) + C dx(k)

    minimise    sum_{k=1..N_p} |y(k) - y_ref(k)|^2_{Q_k} + sum_{k=0..N_p-1} |u_own(k) - u_hover|^2_R
    subject to  u_min <= u_own(k) <= u_max,  |u_own(k) - u_own(k-1)| <= largest change,
                |r_i(k) - r_j(k)| + s >= smallest distance, with penalty p s + p s^2 / 2

The others' inputs are given, (22)-(30). The variables are the owned inputs in units of half their
range, z = (u_own - u0_own) / range, and the slack s.
"""

import itertools

import daqp
import numpy as np
from scipy.linalg import expm

INFINITY = 1e30  # of the solver
TOLERANCE = 1e-10  # of the solver, primal and dual


class Program:
    """Prediction and program of some UAVs of a team, counted from 0."""

    def __init__(self, run, uavs):
        """Take weights, limits and distances from the scenario."""
        settings = run.settings
        N = run.system.N
        self.run = run
        self.steps = run.horizon
        self.own = np.array([4 * uav + j for uav in uavs for j in range(4)])
        self.lower = settings.lower(len(uavs))
        self.upper = settings.upper(len(uavs))
        self.change = settings.step(len(uavs))
        self.range = (self.upper - self.lower) / 2.0

        self.Q = np.tile(settings.weights.Q(N), (self.steps, 1))
        self.Q[-1] *= settings.weights.terminal
        self.R = settings.weights.R(run.system)[self.own]
        every = itertools.combinations(range(N), 2)
        self.pairs = [(i, j) for i, j in every if settings.separation and {i, j} & set(uavs)]

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

    def cost(self, U, Y_ref):
        """Return Hessian and gradient of the cost, 1/2 z' H z + g' z: (26)-(28)."""
        error = self.y0 + self.free(U) @ self.C.T - Y_ref
        S = self.effect(self.C)
        effort = (self.u0 - self.run.u_hover)[self.own]
        weights = 2.0 * self.Q.reshape(-1)
        R = 2.0 * np.tile(self.R * self.range**2, self.steps)
        H = S.T @ (weights[:, None] * S) + np.diag(R)
        g = S.T @ (weights * error.reshape(-1))
        return H, g + np.tile(2.0 * self.R * effort * self.range, self.steps)

    def bounds(self):
        """Return bounds of z; the first step is also within the largest change: (28), (28a)."""
        u0 = self.u0[self.own]
        lower = np.tile(self.lower - u0, (self.steps, 1))
        upper = np.tile(self.upper - u0, (self.steps, 1))
        lower[0] = np.minimum(np.maximum(lower[0], -self.change), upper[0])
        upper[0] = np.maximum(np.minimum(upper[0], self.change), lower[0])
        return (lower / self.range).reshape(-1), (upper / self.range).reshape(-1)

    def distances(self, U):
        """Return rows and lower bounds of the linearised distances: (29)."""
        r = self.y0[: 3 * self.run.system.N].reshape(-1, 3)
        D = np.zeros((len(self.pairs), self.C.shape[1]))
        distance = np.zeros(len(self.pairs))
        for row, (i, j) in enumerate(self.pairs):
            distance[row] = np.linalg.norm(r[i] - r[j])
            towards = (r[i] - r[j]) / distance[row]
            D[row] = towards @ (self.C[3 * i : 3 * i + 3] - self.C[3 * j : 3 * j + 3])
        least = self.run.settings.separation.minimum_m - distance - self.free(U) @ D.T
        return self.effect(D), least.reshape(-1)

    def solve(self, U, Y_ref):
        """Return the optimal own inputs, (N_p, 4 owned). Raises: RuntimeError: there are none."""
        H, g = self.cost(U, Y_ref)
        lower, upper = self.bounds()
        m = len(self.own)
        size = len(g)
        changes = np.kron(np.diff(np.eye(self.steps), axis=0), np.diag(self.range))
        low = -np.tile(self.change, self.steps - 1)
        high = -low
        if self.pairs:
            penalty = self.run.settings.separation.penalty
            rows, least = self.distances(U)
            slack = np.ones((len(rows), 1))
            H = np.block([[H, np.zeros((size, 1))], [np.zeros((1, size)), penalty]])
            g = np.append(g, penalty)
            changes = np.block([[changes, np.zeros((len(low), 1))], [rows, slack]])
            low = np.append(low, least)
            high = np.append(high, np.full(len(least), INFINITY))
            lower = np.append(lower, 0.0)
            upper = np.append(upper, INFINITY)

        below = np.concatenate([lower, low])
        above = np.concatenate([upper, high])
        sense = np.zeros(len(above), dtype=np.int32)
        tolerances = {"primal_tol": TOLERANCE, "dual_tol": TOLERANCE, "iter_limit": 2000}
        z, _, flag, _ = daqp.solve(H, g, changes, above, below, sense, **tolerances)
        if flag <= 0:
            raise RuntimeError(f"DAQP returned {flag}")
        inputs = self.u0[self.own] + z[:size].reshape(-1, m) * self.range
        return np.clip(inputs, self.lower, self.upper)
