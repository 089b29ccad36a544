"""The quadratic program of some UAVs of a team, docs/equations.md (22)-(30).

    minimise    sum_{k=1..N_p} |y(k) - y_ref(k)|^2_{Q_k} + sum_{k=0..N_p-1} |u_own(k) - u_hover|^2_R
    subject to  u_min <= u_own(k) <= u_max,  |u_own(k) - u_own(k-1)| <= largest change,
                |r_i(k) - r_j(k)| + s >= smallest distance, with penalty p s + p s^2 / 2

The others' inputs are given. The variables are z of prediction.py and the slack s.
"""

import itertools

import daqp
import numpy as np
from prediction import Prediction

INFINITY = 1e30  # of the solver
TOLERANCES = {"primal_tol": 1e-10, "dual_tol": 1e-10, "iter_limit": 2000}


class Program(Prediction):
    """Prediction and program of some UAVs, counted from 0."""

    def __init__(self, run, uavs):
        """Take weights, limits and distances from the scenario."""
        super().__init__(run, uavs)
        settings = run.settings
        N = run.system.N
        self.change = settings.largest_step(len(uavs))
        self.Q = np.tile(settings.weights.Q(N), (self.steps, 1))
        self.Q[-1] *= settings.weights.terminal
        self.R = settings.weights.R(run.system)[self.own]
        every = itertools.combinations(range(N), 2)
        self.pairs = [(i, j) for i, j in every if settings.separation and {i, j} & set(uavs)]

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

        return np.clip(
            self.inputs(solved(H, g, changes, [lower, low], [upper, high])[:size]),
            self.lower,
            self.upper,
        )


def solved(H, g, A, lower, upper):
    """Return argmin 1/2 z' H z + g' z, with bounds of z and of A z. Raises: RuntimeError."""
    below = np.concatenate(lower)
    above = np.concatenate(upper)
    z, _, flag, _ = daqp.solve(
        H, g, A, above, below, np.zeros(len(above), dtype=np.int32), **TOLERANCES
    )
    if flag <= 0:
        raise RuntimeError(f"DAQP returned {flag}")
    return z
