"""The cost of the QP: its Hessian and gradient in the scaled decision and the slacks."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from model import native
from model.arrays import Array, padded
from model.linearisation import Linearisation
from model.native import Places
from model.state import input_indices
from mpc import condensing
from mpc.cost import Cost
from mpc.decision import Decision
from mpc.feedback import FeedbackLaw
from mpc.prediction import Linear, Prediction
from mpc.regulation import CostToGo
from mpc.user_costs import UserCosts


@dataclass(frozen=True, slots=True)
class Condensed:
    """The cost in terms of the scaled decision and the slacks, doubled: its value is 1/2 z' H z + g' z.

    Attributes:
        H, g: (n, n), (n,).
        effect: Of the scaled decision on the weighted outputs, (at least these outputs, N_p, m_own).
        free: The weighted outputs at steps 1..N_p without decision, (N_p, outputs).

    The UAVs' positions, which always have a weight, are the first of these outputs.
    """

    H: Array
    g: Array
    effect: Array
    free: Array


class Objective:
    """Tracking error, effort, the user's terms, the cost after the horizon and the penalties of the slacks.

    Penalties of the slacks, (slacks,), are linear and quadratic.
    """

    def __init__(self, decision: Decision, cost: Cost, user_costs: UserCosts, penalties: Array) -> None:
        self._decision, self._user_costs, self._penalties = decision, user_costs, penalties
        self._terminal = decision.settings.weights.terminal
        # Outputs without a weight stay out of the program.
        self._weighted = np.flatnonzero(cost.Q)
        self._effort = cost.R[decision.own] * decision.scale
        self.form(cost, ())

    def form(self, cost: Cost, uncontrolled: Collection[int]) -> None:
        """Set the team: its weights, and its UAVs without an agent, 0-based."""
        self._responding = np.setdiff1d(self._decision.others, input_indices(sorted(uncontrolled)))
        self._Q = np.concatenate([cost.Q[self._weighted], self._user_costs.weights])
        # With the inputs of the other agents' UAVs as further outputs.
        self._Q_with_others = np.concatenate([self._Q, cost.R[self._responding]])

    def fill(
        self, linear: Linear, prediction: Prediction, y_ref: Array, law: FeedbackLaw | None, end: CostToGo | None
    ) -> Condensed:
        """Return the cost in terms of the decision. Arguments as those of `Controller.step`.

        With a cost-to-go, the inputs of the other agents' UAVs, which respond to the state, have the weight they have
        in the shared regulator's cost. Source: docs/equations.md (26)-(27), (36e), (48); paper (25).
        """
        if len(self._user_costs):
            terms = self._user_costs.at(linear.x0)
            slope, at_x0 = np.ascontiguousarray(padded(terms.slope, len(prediction.effect))), terms.value
        else:
            slope, at_x0 = np.zeros((0, len(prediction.effect))), np.zeros(0)
        terminal, responding, Q = self._terminal, _NONE, self._Q
        root, error, end_slope = np.zeros((0, len(prediction.effect))), _NO_END, _NO_END
        if end is not None:
            terminal = 0.0  # the stage cost of the last state is part of the cost-to-go
            root, error, end_slope = end.root, end.error, end.slope
            if law is not None:
                responding, Q = self._responding, self._Q_with_others
        return Condensed(*(native.condense if native.AVAILABLE else _condense)(
            linear.model, self._weighted, responding, self._decision.own, terminal, y_ref, slope, at_x0,
            prediction.effect, prediction.feedback, prediction.dX_free, prediction.U_all, linear.u_target, Q,
            self._decision.scale, self._effort, root, error, end_slope, self._penalties,
        ))  # fmt: skip


def _condense(
    linear: Linearisation, chosen: Places, answering: Places, own: Places, terminal: float, y_ref: Array,
    slope: Array, at_x0: Array, effect: Array, feedback: Array, dX: Array, U: Array, u_target: Array, Q: Array,
    scale: Array, effort: Array, root: Array, error: Array, end_slope: Array, penalties: Array,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return H, g, S and the free response of the chosen outputs, as `Condensed` has them.

    Given are the weighted outputs of the model (`chosen`), the weighted inputs of the others (`answering`) and the
    owned ones; the terminal weight as a multiple of Q; the user's terms, (terms, n), (terms,); the prediction; the
    weights of all outputs, and R times the unit of the decision; and the cost-to-go, whose root has no rows without.
    """
    n, steps, m = effect.shape
    decisions, size, C = steps * m, steps * m + len(penalties), linear.C[chosen]
    free = linear.y[chosen] + dX[1:] @ C.T
    # Step N_p has no input.
    others = np.concatenate([U[1:, answering] - u_target[answering], np.zeros((1, len(answering)))])
    weighted = 2.0 * Q * np.hstack([free - y_ref[1:, chosen], at_x0 + dX[1:] @ slope.T, others])
    weighted[-1] *= terminal
    L = effect.reshape(n, -1)
    S = np.concatenate([C @ L, slope @ L, feedback[answering].reshape(-1, decisions)]).reshape(-1, steps, m) * scale

    H, g = np.zeros((size, size)), np.empty(size)
    H[:decisions, :decisions] = condensing.hessian(S.transpose(1, 0, 2), 2.0 * Q, terminal)
    g[:decisions] = condensing.gradient(S.transpose(1, 0, 2), weighted)
    # Effect of all decisions on the last state, the first one's first.
    last = (effect[:, ::-1] * scale).reshape(n, -1)
    reached = root @ last
    H[:decisions, :decisions] += 2.0 * (reached.T @ reached)
    if len(root):
        g[:decisions] += 2.0 * (reached.T @ (root @ (error + dX[-1])) + end_slope @ last)
    diagonal = H.reshape(-1)[:: size + 1]
    diagonal[:decisions] += np.tile(2.0 * effort * scale, steps)
    diagonal[decisions:] = g[decisions:] = penalties
    g[:decisions] += (2.0 * effort * (U - u_target)[:, own]).reshape(-1)
    return H, g, S, free


_NONE, _NO_END = np.zeros(0, dtype=np.intp), np.zeros(0)
