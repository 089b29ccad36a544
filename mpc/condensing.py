"""The cost of one step as a function of the scaled decision, by products of matrices.

The compiled kernels (`mpc.compiled_program`) compute the same with fewer operations.
"""

from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array
from transport.model.native import Places
from transport.mpc.cost import CostToGo
from transport.mpc.decision import Decision
from transport.mpc.prediction import Linear, Prediction, stacked


@dataclass(frozen=True, slots=True, kw_only=True)
class Objective:
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
    linear = objective.linear
    steps, _ = decision.shape
    dX = prediction.dX_free
    effect = prediction.effect * decision.scale

    # Errors at steps 1..N_p without a decision; step N_p has no input.
    C = linear.model.C[objective.outputs]
    y = linear.model.y[objective.outputs] + dX[1:] @ C.T
    output_error = y - objective.y_ref[1:, objective.outputs]
    term_error = objective.terms + dX[1:] @ objective.slopes.T
    effort = prediction.U_all - linear.u_target
    last_effort = np.zeros(len(objective.responding))
    others_effort = np.vstack([effort[1:, objective.responding], last_effort])
    error = np.hstack([output_error, term_error, others_effort])

    # Impulse responses of the same signals, and the prediction matrix of them.
    on_state = np.tensordot(np.vstack([C, objective.slopes]), effect, 1)
    on_others = prediction.feedback[objective.responding] * decision.scale
    S = stacked(np.concatenate([on_state, on_others]))

    weights = 2.0 * np.tile(objective.Q, (steps, 1))
    weights[-1] *= objective.terminal
    R = 2.0 * objective.effort
    H = S.T @ (weights.reshape(-1, 1) * S) + np.diag(np.tile(R * decision.scale, steps))
    g = S.T @ (weights * error).reshape(-1) + (R * effort[:, decision.own]).reshape(-1)

    # Cost-to-go |root (error + dx)|^2 + 2 slope' dx of the last state, (36e).
    end = objective.end
    if end is not None:
        last = effect[:, ::-1].reshape(len(effect), -1)
        H += 2.0 * last.T @ end.root.T @ end.root @ last
        g += 2.0 * (end.root.T @ (end.root @ (end.error + dX[-1])) + end.slope) @ last
    return (H + H.T) / 2.0, g
