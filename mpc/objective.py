"""The cost of the QP: its Hessian and gradient in the scaled decision and the slacks."""

from collections.abc import Collection

import numpy as np

from model.arrays import Array
from model.state import input_indices
from mpc import condensing
from mpc.cost import Cost
from mpc.decision import Decision
from mpc.feedback import FeedbackLaw
from mpc.prediction import Linear, Prediction
from mpc.regulation import CostToGo
from mpc.user_costs import UserCosts


class Objective:
    """Tracking error, effort, the user's terms, the cost after the horizon and the penalties of the slacks.

    Solvers minimise 1/2 z' H z + g' z: all costs are doubled. Penalties of the slacks, (slacks,), are linear and
    quadratic.
    """

    def __init__(self, decision: Decision, cost: Cost, user_costs: UserCosts, penalties: Array) -> None:
        self._decision, self._user_costs, self._penalties = decision, user_costs, penalties
        self._terminal = decision.settings.weights.terminal
        # Outputs without a weight stay out of the program.
        self._weighted = np.flatnonzero(cost.Q)
        self._effort_slope = 2.0 * cost.R[decision.own] * decision.scale
        self._effort_curvature = np.tile(self._effort_slope * decision.scale, decision.settings.horizon)
        self.form(cost, ())

    def form(self, cost: Cost, uncontrolled: Collection[int]) -> None:
        """Set the team: its weights, and its UAVs without an agent, 0-based."""
        self._R = cost.R
        self._Q = np.concatenate([cost.Q[self._weighted], self._user_costs.weights])
        self._responding = np.setdiff1d(self._decision.others, input_indices(sorted(uncontrolled)))

    def fill(
        self, linear: Linear, prediction: Prediction, y_ref: Array, law: FeedbackLaw | None, end: CostToGo | None
    ) -> tuple[Array, Array, Array]:
        """Return H, g and the effect of the scaled decision on the outputs, (N_p, p', m_own).

        The UAVs' positions, which always have a weight, are the first of these outputs. Arguments as those of
        `Controller.step`. Source: docs/equations.md (26)-(27), (48); paper (25).
        """
        C, error_0 = linear.model.C[self._weighted], (linear.model.y - y_ref)[1:, self._weighted]
        Q, terminal = self._Q, self._terminal
        if len(self._user_costs):
            # The user's terms are further outputs, whose reference is zero.
            terms = self._user_costs.at(linear.x0)
            C = np.concatenate([C, terms.slope])
            error_0 = np.hstack([error_0, np.tile(terms.value, (len(error_0), 1))])
        error = error_0 + prediction.dX_free[1:] @ C.T
        if end is not None:
            terminal = 0.0  # the stage cost of the last state is part of the cost-to-go
            if law is not None and len(self._responding):
                C, error, Q = self._with_effort_of_others(C, error, linear, prediction, law)
        weighted = error * Q
        weighted[-1] *= terminal
        scaled = (C @ prediction.impulse) * self._decision.scale

        decisions, size = self._decision.size, self._decision.size + len(self._penalties)
        H, g = np.zeros((size, size)), np.empty(size)
        condensing.condense(scaled, 2.0 * Q, terminal, 2.0 * weighted, H, g)
        if end is not None:
            # Effect of all decisions on the last state, the first one's first.
            last = (prediction.impulse[::-1].transpose(1, 0, 2) * self._decision.scale).reshape(-1, decisions)
            reached = end.root @ last
            H[:decisions, :decisions] += 2.0 * (reached.T @ reached)
            g[:decisions] += 2.0 * (reached.T @ (end.root @ (end.error + prediction.dX_free[-1])) + end.slope @ last)
        diagonal = H.reshape(-1)[:: size + 1]
        diagonal[:decisions] += self._effort_curvature
        diagonal[decisions:] = self._penalties
        effort = prediction.U_free - linear.u_target[self._decision.own]
        g[:decisions] += (self._effort_slope * effort).reshape(-1)
        g[decisions:] = self._penalties
        return H, g, scaled

    def _with_effort_of_others(
        self, C: Array, error: Array, linear: Linear, prediction: Prediction, law: FeedbackLaw
    ) -> tuple[Array, Array, Array]:
        """Return outputs, errors at steps 1..N_p and weights, extended by the inputs of the other agents' UAVs.

        These inputs respond to the state and have a weight in the shared regulator's cost as well.

        Source: docs/equations.md (36e).
        """
        among_others = np.searchsorted(self._decision.others, self._responding)
        effort = prediction.U_others[:, among_others] - linear.u_target[self._responding]
        effort = np.concatenate([effort[1:], np.zeros((1, len(self._responding)))])  # step N_p has no input
        return (
            np.concatenate([C, law.K[self._responding]]),
            np.hstack([error, effort]),
            np.concatenate([self._Q, self._R[self._responding]]),
        )
