"""The controller as one would write it down from the paper: stacked matrices, multiplied out, and Clarabel.

What (16) and (24)-(27) print is formed block by block as dense matrices and multiplied; nothing is made of their
structure but that powers of A are computed once. For open-loop prediction without constraints of the user's own.
"""

import numpy as np
from scipy.linalg import block_diag

from benchmarks.flights import Situation
from benchmarks.page import BenchmarkError
from model.arrays import Array
from mpc.qp import QP
from mpc.rows.rate import rate_rows
from mpc.rows.separation import pairs_of, separation_rows
from mpc.settings import SolverName
from mpc.solvers import solve


def step(at: Situation, solver: SolverName = "clarabel") -> Array:
    """One step of the controller, as `Controller.step` takes it.

    Args:
        at: Where the step is taken.
        solver: Who solves the program.
    Returns: Inputs of the owned UAVs, (N_p, m_own).
    Raises: BenchmarkError: nobody solves it.
    Source: docs/equations.md (22)-(30); paper (13)-(27).
    """
    controller = at.controller
    settings, own, system = controller.settings, controller.own, controller.model.system
    steps, m, uavs = settings.horizon, len(own), len(controller.owned)
    linear = controller.linearise(at.x0, at.u0)
    discrete = controller.discretise(linear)
    C, y = linear.model.C, linear.model.y

    # X = F + H dU (16), the owned inputs split off (24); y = y_0 + C-bar X.
    powers = [np.eye(system.n)]
    for _ in range(steps):
        powers.append(discrete.A @ powers[-1])
    drift = np.zeros((steps + 1, system.n))
    for k in range(steps):
        drift[k + 1] = discrete.A @ drift[k] + discrete.f_d
    others = np.setdiff1d(np.arange(system.m), own)
    X_free = drift.reshape(-1)
    if len(others):
        X_free = X_free + _stacked(powers, discrete.B[:, others]) @ (at.U - at.u0)[:, others].reshape(-1)
    C_bar = block_diag(*[C] * (steps + 1))
    G = C_bar @ _stacked(powers, discrete.B[:, own])
    Y_free = np.tile(y, steps + 1) + C_bar @ X_free

    # The cost (25): Q-bar with Q_f as its last block; decisions in units of half their range, a slack behind them.
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

    # Bounds, rates from the input in force on, and distances (26)-(27).
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
        raise BenchmarkError(f"naive step: expected its program solved, got {solution.status}")
    inputs = u_free + scale * solution.z[:decisions]
    return np.clip(inputs.reshape(steps, m), lower, upper)


def _stacked(powers: list[Array], B: Array) -> Array:
    """H of (16), and H_i of (24) for the columns B_i: block (k, j) is A^(k-1-j) B below the diagonal."""
    n, m = B.shape
    steps = len(powers) - 1
    H = np.zeros(((steps + 1) * n, steps * m))
    for k in range(steps + 1):
        for j in range(k):
            H[k * n : (k + 1) * n, j * m : (j + 1) * m] = powers[k - 1 - j] @ B
    return H
