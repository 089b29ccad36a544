"""The cost over the horizon, with its terminal weight or cost-to-go, as a function of the scaled decision.

By products of matrices; the compiled kernels (`compiled_program.py`) compute the same with fewer operations.
"""

import msgspec
import numpy as np

from transport.model.arrays import Array
from transport.model.kernels.native import Places
from transport.mpc.program.decision import Decision
from transport.mpc.program.prediction import Linear, Prediction, stacked


class CostToGo(msgspec.Struct, frozen=True, kw_only=True):
    """The cost after the horizon: |root (error + dx)|^2 + 2 slope' dx + constant, (36d)."""

    root: Array  # square root of the Riccati solution, (rank, n)
    error: Array  # x0 - x_ref at step N_p, x_ref shifted by external forces, (n,)
    slope: Array  # effect of reference and forces, (n,)


class Objective(msgspec.Struct, frozen=True, kw_only=True):
    """The cost of one step: outputs, the user's terms and the inputs of other agents' UAVs.

    sum_k |y(k) - y_ref(k)|^2_Q + |u(k) - u_target|^2_R, and the cost after the horizon:
    docs/equations.md (26), (36e), (48).
    """

    linear: Linear
    y_ref: Array  # reference outputs at steps 0..N_p, (N_p + 1, p)
    outputs: Places  # outputs with a weight, (outputs,)
    terms: Array  # the user's terms at x0, (t,)
    slopes: Array  # their gradients, (t, n)
    responding: Places  # inputs of the other agents' UAVs with a weight, (responding,)
    Q: Array  # weights on outputs, terms and these inputs, (outputs + t + responding,)
    effort: Array  # weights on the owned inputs times their scale, (m_own,)
    terminal: float  # weight of step N_p as a multiple of Q
    end: CostToGo | None  # the cost after the horizon, if any


def condense(
    decision: Decision, prediction: Prediction, objective: Objective
) -> tuple[Array, Array]:
    """Return Hessian, (size, size), and gradient, (size,), of the cost, doubled: 1/2 z'Hz + g'z.

    With S the effect of z on all weighted signals and s their error without it,

        H = 2 S' Q S + 2 R,   g = 2 S' Q s + 2 R (u - u_target).

    Source: docs/equations.md (26)-(28), (36e), (48); paper (25)-(27).
    """
    error = _error(prediction, objective)
    S = _effect(decision, prediction, objective)
    R = 2.0 * objective.effort
    effort = prediction.U_all[:, decision.own] - objective.linear.u_target[decision.own]

    # Q of steps 1..N_p, the last one that of the terminal weight, doubled.
    steps, _ = decision.shape
    Q = 2.0 * np.tile(objective.Q, (steps, 1))
    Q[-1] *= objective.terminal

    H = S.T @ (Q.reshape(-1, 1) * S) + np.diag(np.tile(R * decision.scale, steps))
    g = S.T @ (Q * error).reshape(-1) + (R * effort).reshape(-1)

    # Cost-to-go |root (error + dx)|^2 + 2 slope' dx of the last state, (36e).
    end = objective.end
    if end is not None:
        effect = prediction.effect * decision.scale
        last = effect[:, ::-1].reshape(len(effect), -1)
        ahead = end.root.T @ (end.root @ (end.error + prediction.dX_free[-1])) + end.slope
        H += 2.0 * last.T @ end.root.T @ end.root @ last
        g += 2.0 * ahead @ last
    return (H + H.T) / 2.0, g


def _error(prediction: Prediction, objective: Objective) -> Array:
    """Return s, the errors of the weighted signals at steps 1..N_p without a decision.

    (N_p, outputs + t + responding); step N_p has no input.
    """
    linear = objective.linear
    dX = prediction.dX_free
    C = linear.model.C[objective.outputs]
    y = linear.model.y[objective.outputs] + dX[1:] @ C.T
    outputs = y - objective.y_ref[1:, objective.outputs]

    terms = objective.terms + dX[1:] @ objective.slopes.T

    effort = prediction.U_all - linear.u_target
    last_effort = np.zeros(len(objective.responding))
    others = np.vstack([effort[1:, objective.responding], last_effort])
    return np.hstack([outputs, terms, others])


def _effect(decision: Decision, prediction: Prediction, objective: Objective) -> Array:
    """Return S, the effect of the scaled decision on the weighted signals: (25)."""
    C = objective.linear.model.C[objective.outputs]
    on_states = prediction.effect * decision.scale
    on_signals = np.tensordot(np.vstack([C, objective.slopes]), on_states, 1)
    on_others = prediction.feedback[objective.responding] * decision.scale
    return stacked(np.concatenate([on_signals, on_others]))
