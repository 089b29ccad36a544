"""The QP of one step in the scaled decision and the slacks."""

from collections.abc import Collection

import numpy as np

from transport.model.arrays import Array, frozen, padded
from transport.model.kernels import native
from transport.model.linear.discretisation import Discrete
from transport.model.state import input_indices
from transport.mpc.program.compiled_program import CompiledProgram
from transport.mpc.program.constraints import constraints_of
from transport.mpc.program.constraints.stack import Rows, Stack
from transport.mpc.program.decision import Decision
from transport.mpc.program.feedback_law import FeedbackLaw
from transport.mpc.program.horizon_and_terminal_cost import CostToGo, Objective, condense
from transport.mpc.program.prediction import Linear, Prediction, follow, own_response, predict
from transport.mpc.program.quadratic_program import QP
from transport.mpc.program.relaxation import Relaxation, relaxed
from transport.mpc.program.rollout import Rollout
from transport.mpc.program.stage_cost import Cost
from transport.mpc.program.trajectory import Announced, TimeInvariant
from transport.mpc.program.user_expressions import UserCosts

_NONE = np.zeros(0, dtype=np.intp)
frozen(_NONE)


class Program:
    """Prediction and QP of one controller about the present state.

    With compiled kernels both are views of buffers that the next `predict` overwrites.
    """

    def __init__(self, decision: Decision, cost: Cost, user_costs: UserCosts) -> None:
        self.decision = decision
        self.stack = Stack(decision, constraints_of(decision))
        self._uncompiled = [each for each in self.stack.constraints if not each.in_kernel]
        self._user_costs = user_costs

        system = decision.system
        settings = decision.settings
        self._n = system.n + (system.m if settings.motor_lag_s > 0.0 else 0)
        # Outputs without a weight stay out of the program.
        self._outputs = np.flatnonzero(cost.Q)
        self._effort = cost.R[decision.own] * decision.scale
        self._no_terms = np.zeros(0), np.zeros((0, self._n))
        frozen(*self._no_terms)

        # A + B_others K and B_own of the last prediction along a trajectory; None after one about x0.
        self._closed_loop: tuple[Array, Array] | None = None
        # What all agents have announced, for the newest prediction along a trajectory.
        self._announced: tuple[Prediction, Announced] | None = None
        self.compiled: CompiledProgram | None = None
        if native.AVAILABLE:
            self.compiled = CompiledProgram(
                decision, self.stack, self._n, self._outputs, len(user_costs), self._effort
            )
        self.form(cost, ())

    def form(self, cost: Cost, uncontrolled: Collection[int]) -> None:
        """Set the team: its weights, and its UAVs without an agent, 0-based."""
        without_agent = input_indices(sorted(uncontrolled))
        others = self.decision.others
        self._responding = others[~np.isin(others, without_agent)]
        self._Q = np.concatenate([cost.Q[self._outputs], self._user_costs.weights])
        # With the inputs of the other agents' UAVs as further outputs, (36e).
        self._Q_with_others = np.concatenate([self._Q, cost.R[self._responding]])
        frozen(self._responding, self._Q, self._Q_with_others)

    def predict(
        self,
        linear: Linear,
        discrete: Discrete,
        U: Array,
        law: FeedbackLaw | None,
        along: Rollout | None = None,
    ) -> Prediction:
        """Predict the team over the horizon, at steps 1..N_p.

        Args:
            linear: Expansion of the model about x0 and u0.
            discrete: Its zero-order hold over the sampling period.
            U: Inputs of the team that the others apply, (N_p, m), N and N m (or rad/s); not used with a
                control law.
            law: Shared control law by which the others answer, with their corrections; None: they
                apply U.
            along: Trajectory of the nonlinear model about which the prediction is exact, (35a); None:
                by the expansion about x0 alone.
        Source: docs/equations.md (22)-(24), (35), (36).
        """
        if self.compiled is None:
            prediction = predict(discrete, linear.u0, self.decision.own, U, law)
            dynamics_changed = True
        else:
            prediction, dynamics_changed = self.compiled.respond(
                linear, discrete, U, law, only_new=along is not None
            )

        self._announced = None
        if law is None or along is None:
            self._closed_loop = None  # the next A and B may have changed since it was made
        else:
            # The closed loop is kept from one trajectory to the next with the same A, B and K.
            if dynamics_changed:
                self._closed_loop = None
            self._follow(prediction, along, law, discrete, linear.u0)
            self._announced = prediction, Announced(U=along.U, c=law.c)
        return prediction

    def _follow(
        self,
        prediction: Prediction,
        along: Rollout,
        law: FeedbackLaw,
        discrete: Discrete,
        u0: Array,
    ) -> None:
        """Make the free response of a prediction exact along a trajectory, (35a), in place."""
        own = self.decision.own
        # Closed loop of the others: A + B_q K, with B_q = B without the own columns.
        if self._closed_loop is None:
            B_others = discrete.B.copy()
            B_others[:, own] = 0.0
            self._closed_loop = discrete.A + B_others @ law.K, discrete.B[:, own]
        A_closed, B_own = self._closed_loop
        v = along.U[:, own] - u0[own]
        by_own = own_response(A_closed, B_own, v)
        follow(prediction, along, by_own, law, u0, own)

    def condense(
        self,
        linear: Linear,
        prediction: Prediction,
        y_ref: Array,
        law: FeedbackLaw | None,
        end: CostToGo | None,
    ) -> QP:
        """Return the QP of a prediction in the scaled decision and the slacks.

        Args:
            linear: Expansion of the model, as in `predict`.
            prediction: The newest result of `predict`, or an older one without compiled kernels.
            y_ref: References of the outputs at steps 0..N_p, (N_p + 1, p), as the outputs.
            law: Shared control law, as in `predict`.
            end: Cost-to-go of the last state; None: the terminal weight on its outputs.
        Source: docs/equations.md (26)-(30), (36e), (48); paper (25)-(27).
        """
        objective = self._objective(linear, y_ref, law, end)
        announced = None
        if self._announced is not None and self._announced[0] is prediction:
            announced = self._announced[1]
        trajectory = TimeInvariant(
            decision=self.decision, linear=linear, prediction=prediction, announced=announced
        )
        if self.compiled is None or not self.compiled.is_newest(prediction):
            return self._without_kernels(objective, trajectory)

        self.compiled.condense(objective)
        qp = self.compiled.qp
        rows = Rows(A=qp.A, lower=qp.row_lower, upper=qp.row_upper)
        self.stack.fill(rows, trajectory, self._uncompiled)
        return qp

    def relaxed(
        self, prediction: Prediction, law: FeedbackLaw, z: Array, w: float
    ) -> tuple[Array, Array]:
        """Return own inputs and corrections, (N_p, m_own) each, with relaxation: (36a).

        z is the solution of `condense`, w its weight, 0 without one.
        """
        if self.compiled is not None and self.compiled.follows(prediction, law):
            return self.compiled.relaxed(z, w)
        own = self.decision.own
        mixture = Relaxation(at_x0=law.uncorrected[:, own], previous=law.c[:, own], w=w)
        return relaxed(self.decision, prediction, mixture, z)

    def _objective(
        self, linear: Linear, y_ref: Array, law: FeedbackLaw | None, end: CostToGo | None
    ) -> Objective:
        """Return the cost of one step."""
        terms, slopes = self._no_terms
        if len(self._user_costs):
            terms, slopes = self._user_costs.at(linear.x0)
            slopes = np.ascontiguousarray(padded(slopes, self._n))

        # A cost-to-go contains the stage cost of the last state, and the others' effort.
        counts_others = end is not None and law is not None
        terminal = self.decision.settings.weights.terminal if end is None else 0.0
        return Objective(
            linear=linear,
            y_ref=y_ref,
            outputs=self._outputs,
            terms=terms,
            slopes=slopes,
            responding=self._responding if counts_others else _NONE,
            Q=self._Q_with_others if counts_others else self._Q,
            effort=self._effort,
            terminal=terminal,
            end=end,
        )

    def _without_kernels(self, objective: Objective, trajectory: TimeInvariant) -> QP:
        """Return the QP by products of matrices.

        min 1/2 z'Hz + g'z + sum_i p_i (s_i^2 / 2 + s_i), with the slacks s >= 0 behind z and their
        penalties p.
        """
        H, g = condense(self.decision, trajectory.prediction, objective)
        penalties = self.stack.penalties
        decided = len(g)
        H_with_slacks = np.diag(np.concatenate([np.zeros(decided), penalties]))
        H_with_slacks[:decided, :decided] = H

        U_free = trajectory.prediction.U_free
        lower, upper = self.decision.bounds(U_free, objective.linear.u0)
        rows = self.stack.about(trajectory)
        return QP(
            H=H_with_slacks,
            g=np.concatenate([g, penalties]),
            lower=np.concatenate([lower, np.zeros(len(penalties))]),
            upper=np.concatenate([upper, np.full(len(penalties), np.inf)]),
            A=rows.A,
            row_lower=rows.lower,
            row_upper=rows.upper,
        )
