"""The program of an agent along a reference: corrections about the trajectory of the control law.

The team's cost is constant + sum_k c(k)' M(k) c(k), (72), so the optimum follows from the others'
corrections; a QP is solved only where its trajectory violates a constraint.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.obstacles import Obstacle
from transport.mpc.program.constraints import constraints_of
from transport.mpc.program.constraints.block import Constraint
from transport.mpc.program.constraints.input_limits import InputBounds, Rates, within_limits
from transport.mpc.program.constraints.obstacle_distance import Clearance
from transport.mpc.program.constraints.stack import Rows, Stack
from transport.mpc.program.decision import Decision
from transport.mpc.program.feedback_law import FeedbackLaw, Gains
from transport.mpc.program.prediction import Linear
from transport.mpc.program.quadratic_program import QP
from transport.mpc.program.rollout import Actuation, OwnRates, rollout
from transport.mpc.program.trajectory import TimeVarying

# From this share of the range of inputs on, or of m, rad or N, a constraint counts as violated.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """Trajectory under the law with the corrections that are optimal without constraints."""

    law: FeedbackLaw  # with these corrections
    linear: Linear  # of the step
    trajectory: TimeVarying
    within: bool  # whether no constraint is violated

    @property
    def Z(self) -> Array:
        """States at steps 0..N_p, (N_p + 1, n)."""
        return self.trajectory.Z

    @property
    def U_all(self) -> Array:
        """Inputs, the owned ones without limits, (N_p, m)."""
        return self.trajectory.U


class CourseProgram:
    """QP about the trajectory of the law; the decision changes the owned corrections."""

    def __init__(self, decision: Decision, obstacles: Sequence[Obstacle] = ()) -> None:
        self._decision = decision
        self._actuation = Actuation.of(decision.settings, decision.system.N)
        self._free = self._actuation.without_limits(decision.own)

        constraints: list[Constraint] = [InputBounds(decision), *constraints_of(decision)]
        if obstacles:
            constraints.append(Clearance(decision, obstacles))
        self.stack = Stack(decision, constraints)
        # Constraints on states; those on inputs are judged relative to their range.
        self._on_states = [
            each for each in constraints if not isinstance(each, InputBounds | Rates)
        ]

    def course(
        self, model: Model, linear: Linear, law: FeedbackLaw, gains: Sequence[Gains]
    ) -> Course:
        """Return the trajectory of a step with the optimal corrections c_o = -M_oo^-1 M_oq c_q.

        Source: docs/equations.md (72), (73).
        """
        own = self._decision.own
        others = self._decision.others
        c = law.c.copy()
        c[:, own] = 0.0
        if c.any():
            M = np.array([at.M for at in gains])
            coupled = np.einsum("kij,kj->ki", M[:, own[:, None], others], c[:, others])
            c[:, own] = -np.linalg.solve(M[:, own[:, None], own], coupled[:, :, None])[:, :, 0]
        law = msgspec.structs.replace(law, c=c)

        Z, U = rollout(model, self._free, linear.x0, law, linear.forces)
        trajectory = TimeVarying(
            decision=self._decision, model=model, law=law, gains=gains, Z=Z, U=U, u0=linear.u0
        )
        # Inputs follow from all states: where one is no number, they are not within their limits.
        within = within_limits(trajectory, _ROUNDING) and self._holds(trajectory)
        return Course(law=law, linear=linear, trajectory=trajectory, within=within)

    def program(self, course: Course) -> QP:
        """Return the QP of a course, without rows if it violates no constraint.

        minimise sum_k dc_o(k)' M_oo(k) dc_o(k) + penalties of slacks, docs/equations.md (74).
        A slack s >= 0 costs penalty * (s + s^2 / 2).
        """
        m = self._decision.shape[1]
        size = self._decision.size
        own = self._decision.own
        scale = self._decision.scale
        penalties = self.stack.penalties
        if course.within:
            penalties = penalties[:0]
        slacks = len(penalties)

        H = np.zeros((size + slacks, size + slacks))
        for k, at in enumerate(course.trajectory.gains):
            block = slice(m * k, m * (k + 1))
            H[block, block] = 2.0 * scale[:, None] * at.M[np.ix_(own, own)] * scale
        of_slacks = range(size, size + slacks)
        H[of_slacks, of_slacks] = penalties

        none = Rows(A=np.zeros((0, size)), lower=np.zeros(0), upper=np.zeros(0))
        rows = none if course.within else self.stack.about(course.trajectory)
        return QP(
            H=H,
            g=np.concatenate([np.zeros(size), penalties]),
            lower=np.concatenate([np.full(size, -np.inf), np.zeros(slacks)]),
            upper=np.full(size + slacks, np.inf),
            A=rows.A,
            row_lower=rows.lower,
            row_upper=rows.upper,
        )

    def planned(
        self, model: Model, course: Course, announced: FeedbackLaw, z: Array, w: float
    ) -> tuple[Array, Array]:
        """Return owned inputs and corrections of a plan, (N_p, m_own) each.

        c = w (c_course + dc) + (1 - w) c_announced, and the inputs that follow within the limits;
        dc is that of the solution z, with weight w.
        """
        own = self._decision.own
        optimal = course.law.c[:, own]
        previous = announced.c[:, own]
        if course.within and (w == 1.0 or np.array_equal(optimal, previous)):
            return self._decision.clip(course.U_all[:, own]), optimal

        c = announced.c.copy()
        c[:, own] = w * (optimal + self._decision.inputs(z)) + (1.0 - w) * previous
        law = msgspec.structs.replace(course.law, c=c)
        limited = OwnRates(decision=self._decision, before=course.linear.u0[own])
        forces = course.linear.forces
        U = rollout(model, self._actuation, course.Z[0], law, forces, limited).U
        return U[:, own], c[:, own]

    def _holds(self, trajectory: TimeVarying) -> bool:
        """Return whether a trajectory keeps all constraints on states."""
        return all(each.block(trajectory).holds(_ROUNDING) for each in self._on_states)
