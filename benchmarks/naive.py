"""The controller's step in the paper's stacked matrices, solved by Clarabel.

The matrices of (16) and (24)-(27) are formed block by block, dense, and multiplied; of their structure only the powers
of A are used, computed once. For open-loop prediction without user constraints.
"""

import numpy as np
from scipy.linalg import block_diag

from benchmarks.page import BenchmarkError
from benchmarks.runs import Situation
from model.arrays import Array
from mpc.qp import QP
from mpc.rows import pairs_of, rate_rows, separation_rows
from mpc.settings import SolverName
from mpc.solvers import solve


def step(at: Situation, solver: SolverName = "clarabel") -> Array:
    """Return the inputs of the owned UAVs, as `Controller.step` does, (N_p, m_own).

    Raises: BenchmarkError: the program is not solved.
    Source: docs/equations.md (22)-(30); paper (13)-(27).
    """
    controller = at.controller
    settings, own, system = controller.settings, controller.own, controller.model.system
    steps, m, uavs = settings.horizon, len(own), len(controller.owned)
    linear = controller.linearise(at.x0, at.u0)
    discrete = controller.discretise(linear)
    C, y = linear.model.C, linear.model.y

    # X = F + H dU (16), the owned inputs split off (24); y = y_0 + C-bar X.
    powers = powers_of(discrete.A, steps)
    drift = np.zeros((steps + 1, system.n))
    for k in range(steps):
        drift[k + 1] = discrete.A @ drift[k] + discrete.f_d
    others = np.setdiff1d(np.arange(system.m), own)
    X_free = drift.reshape(-1)
    if len(others):
        X_free = X_free + stacked_input(powers, discrete.B[:, others]) @ (at.U - at.u0)[:, others].reshape(-1)
    C_bar = block_diag(*[C] * (steps + 1))
    G = C_bar @ stacked_input(powers, discrete.B[:, own])
    Y_free = np.tile(y, steps + 1) + C_bar @ X_free

    # The cost (25): Q-bar with Q_f as its last block; decisions in units of half their range, then a slack.
    Q, R = controller.cost.Q, np.tile(controller.cost.R[own], steps)
    Q_bar = np.diag(np.concatenate([np.tile(Q, steps), settings.weights.terminal * Q]))
    lower, upper = settings.limits.lower(uavs), settings.limits.upper(uavs)
    scale = np.tile((upper - lower) / 2.0, steps)
    S = np.diag(scale)
    pairs, separation = pairs_of(system.N, controller.owned), settings.separation
    slacks = int(separation is not None and len(pairs) > 0)
    decisions = steps * m
    H = np.eye(decisions + slacks) * (separation.penalty if separation else 0.0)
    H[:decisions, :decisions] = 2.0 * S @ (G.T @ Q_bar @ G + np.diag(R)) @ S
    g = np.full(decisions + slacks, separation.penalty if separation else 0.0)
    from_target = np.tile(at.u0[own] - linear.u_target[own], steps)
    g[:decisions] = 2.0 * S @ (G.T @ Q_bar @ (Y_free - at.y_ref.reshape(-1)) + R * from_target)

    # Bounds, rates beginning at the input in force, and distances (26)-(27).
    change = settings.limits.step(uavs, settings.sampling_period_s)
    rates = np.zeros((decisions, decisions + slacks))
    rates[:m, :m] = np.eye(m)
    rates[m:, :decisions] = rate_rows(steps, m)
    rates[:, :decisions] = rates[:, :decisions] @ S
    rows, row_lower, row_upper = [rates], [np.tile(-change, steps)], [np.tile(change, steps)]
    if slacks and separation:
        between = np.zeros((len(pairs), len(y)))
        between[:, : 3 * system.N] = separation_rows(y[: 3 * system.N], pairs)[1]
        distances = block_diag(*[between] * (steps + 1))[len(pairs) :]
        rows.append(np.column_stack([distances @ G @ S, np.ones(len(distances))]))
        row_lower.append(separation.minimum_m - distances @ Y_free)
        row_upper.append(np.full(len(distances), np.inf))
    u_free = np.tile(at.u0[own], steps)
    qp = QP(
        H=(H + H.T) / 2.0,
        g=g,
        lower=np.concatenate([(np.tile(lower, steps) - u_free) / scale, np.zeros(slacks)]),
        upper=np.concatenate([(np.tile(upper, steps) - u_free) / scale, np.full(slacks, np.inf)]),
        A=np.concatenate(rows),
        row_lower=np.concatenate(row_lower),
        row_upper=np.concatenate(row_upper),
    )
    solution = solve(qp, solver)
    if solution.status != "solved":
        raise BenchmarkError(f"naive step: expected a solved program, got {solution.status}")
    inputs = u_free + scale * solution.z[:decisions]
    return np.clip(inputs.reshape(steps, m), lower, upper)


def powers_of(A: Array, steps: int) -> list[Array]:
    """Return A^0, A^1, ... A^steps."""
    powers = [np.eye(len(A))]
    for _ in range(steps):
        powers.append(A @ powers[-1])
    return powers


def stacked_input(powers: list[Array], B: Array) -> Array:
    """Return H of (16), or H_i of (24) for the columns B_i: block (k, j) is A^(k-1-j) B below the diagonal."""
    n, m = B.shape
    steps = len(powers) - 1
    H = np.zeros(((steps + 1) * n, steps * m))
    for k in range(steps + 1):
        for j in range(k):
            H[k * n : (k + 1) * n, j * m : (j + 1) * m] = powers[k - 1 - j] @ B
    return H
