"""The announced plan: relaxed solution, fallback to the previous plan, and plans made under another control law."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from model.arrays import Array
from model.discretisation import Discrete
from mpc.decision import Decision
from mpc.feedback import FeedbackLaw
from mpc.prediction import Prediction, convolve, free_response
from mpc.program import Program
from mpc.qp import Solution


@dataclass(frozen=True, slots=True, kw_only=True)
class StepResult:
    """Plan of one step.

    Attributes:
        U: Absolute inputs of the owned UAVs to announce and apply, (N_p, 4 owned); after a failed solve
            the previous plan, shifted.
        c: Their corrections to the shared control law, (N_p, 4 owned); (0, 4 owned) without that law.
        solution: Of the QP, solved or not.
    """

    U: Array
    c: Array
    solution: Solution


def relaxed(
    program: Program, solution: Solution, prediction: Prediction, U: Array, law: FeedbackLaw | None, w: float
) -> StepResult:
    """Return the plan w U* + (1 - w) U_previous; with a shared control law only the corrections are mixed.

    Then the stabilising feedback acts in full, and the inputs follow from the control law and the mixed corrections.
    Without a solution, the previous plan or its corrections are taken as they are.

    Args: as those of `Controller.conclude`, with the relaxation weight w in (0, 1].
    Source: docs/equations.md (30a), (36a).
    """
    decision, solved = program.decision, solution.status == "solved"
    z = solution.z[: decision.size] if solved else np.zeros(decision.size)
    if law is None:
        previous = U[:, decision.own]
        # The solver meets the bounds to its tolerance; the plant's actuators have them exactly.
        best = decision.clip(prediction.U_free + decision.inputs(z))
        inputs = decision.clip(w * best + (1.0 - w) * previous) if solved else previous.copy()
        return StepResult(U=inputs, c=np.zeros((0, len(decision.own))), solution=solution)
    inputs, c = program.relaxed(prediction, law, z, w if solved else 0.0)
    return StepResult(U=inputs, c=c, solution=solution)


def fallback(decision: Decision, solution: Solution, U: Array, law: FeedbackLaw | None) -> StepResult:
    """Return the previous plan within bounds; arguments as those of `relaxed`."""
    c = np.zeros((0, len(decision.own))) if law is None else law.c[:, decision.own]
    return StepResult(U=decision.clip(U[:, decision.own]), c=c, solution=solution)


def foreseen(decision: Decision, prediction: Prediction, inputs: Array) -> Array:
    """Return the inputs of all UAVs over the horizon as one controller expects them, within bounds, (N_p, m).

    The owned inputs are given, (N_p, m_own). Source: docs/equations.md (35), (36).
    """
    U: Array = prediction.U_all + convolve(prediction.feedback, inputs - prediction.U_free)
    U[:, decision.own] = inputs
    N, limits = decision.system.N, decision.settings.limits
    return np.clip(U, limits.lower(N), limits.upper(N))


def adapted(law: FeedbackLaw, discrete: Discrete, u0: Array, U: Array, columns: npt.NDArray[np.intp]) -> FeedbackLaw:
    """Return the control law whose corrections, in some columns, reproduce inputs announced under another one.

    Args:
        law: The shared control law over the horizon.
        discrete: Zero-order hold about (x0, u0).
        u0: Input of the linearisation, (m,).
        U: Announced inputs of all UAVs over the horizon, (N_p, m).
        columns: Positions in u.
    Source: docs/equations.md (46).
    """
    dX = free_response(discrete.A, discrete.f_d + (U - u0) @ discrete.B.T)
    c = law.c.copy()
    c[:, columns] = U[:, columns] - law.uncorrected[:, columns] - dX[:-1] @ law.K[columns].T
    return replace(law, c=c)
