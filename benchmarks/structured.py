"""Condensed solution against a Riccati recursion over the states, for horizons of any length."""

from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.effort import Effort
from benchmarks.flights import Situation, setup, situations
from benchmarks.page import Table
from benchmarks.timing import digits, in_turns
from model.arrays import Array
from mpc import bounded, condensing
from mpc.prediction import Prediction, open_loop

TEXT = (
    "Processor time in ms, medians, from a discrete model to the optimum without limits: condensed (responses, "
    "Hessian, gradient, factorisation) and by a Riccati recursion over the states, whose time is linear in the "
    "horizon. Four UAVs: 60 states, and 4 decisions per step for an agent of `paper`, 16 for that of `centralized`."
)


def measure(effort: Effort, log: Callable[[str], None]) -> list[Table]:
    """Compare both solutions over horizons."""
    rows = []
    for name in ("paper", "centralized"):
        at = situations(setup(name, effort.climb), 1)[0]
        for steps in effort.structured:
            log(f"{name}, N_p = {steps}")
            tasks = {"condensed": partial(condensed, at, steps), "riccati": partial(riccati, at, steps)}
            medians = [times.median for times in in_turns(tasks, effort.repetitions).values()]
            rows.append((name, str(steps), *map(digits, [*medians, medians[1] / medians[0]])))
    return [Table(text=TEXT, columns=("scenario", "N_p", "condensed", "Riccati", "ratio"), rows=rows)]


def condensed(at: Situation, steps: int) -> Array:
    """Return the optimal deviations of the owned inputs from those in force, without limits, (N_p, m_own)."""
    prediction, C, errors, Q, R, target = _problem(at, steps)
    S = C @ prediction.impulse
    m = S.shape[2]
    weighted = (errors + prediction.dX_free @ C.T)[1:] * Q
    terminal = at.controller.settings.weights.terminal
    weighted[-1] *= terminal
    H, g = np.zeros((steps * m, steps * m)), np.empty(steps * m)
    condensing.condense(S, Q, terminal, weighted, H, g)
    H.reshape(-1)[:: steps * m + 1] += np.tile(R, steps)
    g += (R * (prediction.U_free - target)).reshape(-1)
    free = np.full(steps * m, np.inf)
    return bounded.solve(H, g, -free, free)[0].reshape(steps, m)


def riccati(at: Situation, steps: int) -> Array:
    """Return the same deviations by dynamic programming over the states."""
    prediction, C, errors, Q, R, target = _problem(at, steps, condensed=False)
    A, B, W = prediction.A, prediction.B, prediction.W
    CQ = C.T * Q
    stage, terminal = CQ @ C, at.controller.settings.weights.terminal
    P, p = terminal * stage, terminal * (CQ @ errors[steps])
    gains, offsets = [], []
    for k in range(steps - 1, -1, -1):
        PB = P @ B
        ahead = P @ W[k] + p
        G = B.T @ PB + np.diag(R)
        solved = np.linalg.solve(G, np.column_stack([PB.T @ A, B.T @ ahead + R * (prediction.U_free[k] - target)]))
        K, offset = solved[:, :-1], solved[:, -1]
        gains.append(K)
        offsets.append(offset)
        closed = A - B @ K
        P, p = stage + A.T @ P @ closed, CQ @ errors[k] + A.T @ (ahead - PB @ offset)
    V, dx = np.empty((steps, B.shape[1])), np.zeros(len(A))
    for k, (K, offset) in enumerate(zip(reversed(gains), reversed(offsets), strict=True)):
        V[k] = -K @ dx - offset
        dx = A @ dx + B @ V[k] + W[k]
    return V


def _problem(
    at: Situation, steps: int, *, condensed: bool = True
) -> tuple[Prediction, Array, Array, Array, Array, Array]:
    """Return prediction, C, errors at steps 0..N_p, weights, and target of the owned inputs for a horizon."""
    controller = at.controller
    linear = controller.linearise(at.x0, at.u0)
    discrete = controller.discretise(linear)
    own = controller.own
    errors = linear.model.y - np.repeat(at.y_ref[-1:], steps + 1, axis=0)
    if condensed:
        others, U = np.setdiff1d(np.arange(len(at.u0)), own), np.repeat(at.u0[None], steps, axis=0)
        prediction = open_loop(discrete, at.u0, own, others, U)
    else:
        none = np.zeros((0, 0))
        prediction = Prediction(
            A=discrete.A,
            B=discrete.B[:, own],
            impulse=none,
            dX_free=none,
            U_free=np.repeat(at.u0[own][None], steps, axis=0),
            W=np.repeat(discrete.f_d[None], steps, axis=0),
            U_others=none,
        )
    return prediction, linear.model.C, errors, controller.cost.Q, controller.cost.R[own], linear.u_target[own]
