"""Relaxed plans under the shared law: new corrections mixed with the previous ones, (36a)."""

from dataclasses import dataclass

from transport.model.arrays import Array
from transport.mpc.program.decision import Decision
from transport.mpc.program.prediction import Prediction, convolve


@dataclass(frozen=True, slots=True, kw_only=True)
class Relaxation:
    """The data that a new optimum is mixed with."""

    at_x0: Array  # owned inputs by the law with the state held at x0, (N_p, m_own)
    previous: Array  # previous corrections, shifted, (N_p, m_own)
    w: float  # weight of the new corrections, 0 if the program has no solution


def relaxed(
    decision: Decision, prediction: Prediction, plan: Relaxation, z: Array
) -> tuple[Array, Array]:
    """Return owned inputs and corrections, (N_p, m_own) each, of a solution z and its weight w.

    The corrections reproduce the optimal inputs: c = u - u_law(x0) - K dX - K S v, (36a). For w < 1
    they are mixed with the previous ones, and the inputs follow from the law with bounds and rates.
    """
    U_free = prediction.U_free
    fed_back = prediction.dU_free[:, decision.own]
    feedback = prediction.feedback[decision.own]
    best = decision.clip(U_free + decision.inputs(z))

    c = plan.previous
    if plan.w > 0.0:
        c_best = best - plan.at_x0 - fed_back - convolve(feedback, best - U_free)
        if plan.w == 1.0:
            return best, c_best
        c = plan.w * c_best + (1.0 - plan.w) * plan.previous

    # The corrections may come from a plan of another team: the rates hold.
    wanted = plan.at_x0 + c + fed_back
    U = U_free.copy()
    before = U_free[0]
    for k in range(len(U)):
        answer = convolve(feedback[:, : k + 1], (U - U_free)[: k + 1])[-1]
        U[k] = decision.limit_rate(wanted[k] + answer, before)
        before = U[k]
    return U, c
