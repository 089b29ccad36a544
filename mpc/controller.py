"""One controller for any set of owned UAVs.

One is the paper's distributed controller, all the centralized one.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from transport.model import state
from transport.model.arrays import Array, all_finite, frozen, within
from transport.model.kernels.native import Places
from transport.model.linear.discretisation import Discrete, euler, zero_order_hold
from transport.model.linear.linearisation import Jacobians, Linearisation, Model
from transport.model.linear.motor_lag import with_lag
from transport.model.physics.hover import Hover
from transport.model.physics.obstacles import Obstacle
from transport.model.state import LARGEST
from transport.mpc.law.present_law import Regulation
from transport.mpc.program.constraints.softened_user_constraints import Softening
from transport.mpc.program.constraints.user_constraints import OwnInputs, OwnStates
from transport.mpc.program.corrections_along_reference import Course, CourseProgram
from transport.mpc.program.decision import Decision
from transport.mpc.program.feedback_law import FeedbackLaw
from transport.mpc.program.horizon_and_terminal_cost import CostToGo
from transport.mpc.program.prediction import Linear, Prediction, convolve
from transport.mpc.program.qp_solvers import solve
from transport.mpc.program.qp_with_slacks import Program
from transport.mpc.program.quadratic_program import QP, Solution, unsolved
from transport.mpc.program.rollout import Actuation, Rollout, rollout
from transport.mpc.program.stage_cost import Cost
from transport.mpc.reference import Sampled
from transport.mpc.settings_period_horizon_weights import ControllerSettings

# A trajectory beyond these angles of payload or UAVs, rad, is not followed: Euler angles become
# singular.
_STEEPEST = 1.3


@dataclass(frozen=True, slots=True, kw_only=True)
class Horizon:
    """Data of one step over the horizon."""

    # Announced inputs of all UAVs, (N_p, m); the owned columns hold the previous plan, shifted.
    U: Array
    y_ref: Array  # reference outputs at steps 0..N_p, (N_p + 1, p)
    law: FeedbackLaw | None = None  # shared control law, with closed-loop prediction
    end: CostToGo | None = None  # the cost after the horizon, with terminal "riccati"


class StepResult(msgspec.Struct, frozen=True, kw_only=True):
    """Plan of one step."""

    # Inputs of the owned UAVs to announce and apply, (N_p, 4 owned); after a failed solve the
    # previous plan.
    U: Array
    # Their corrections to the shared control law, (N_p, 4 owned); (0, 4 owned) without that law.
    c: Array
    solution: Solution  # of the QP, solved or not


class Controller:
    """Model predictive control of the owned UAVs, given the announced inputs of the others.

    `step` is its work in one call. An agent calls the stages itself, in this order: `linearise`,
    `discretise`, `predict`, `condense`, `solve`, `conclude`. Between them the controller keeps two
    things: `condense` subtracts the curvature that the newest `predict` has found, and `solve`
    softens the constraints of the program that the newest `condense` has formed.

    Args:
        reference: What the control law follows; None for hover.
        obstacles: What the team keeps clear of; ignored unless the reference is flat.

    Raises: SettingsError: an expression of the settings cannot be read or evaluated. FeedbackError:
    the settings need a regulator and none stabilises the team.
    """

    def __init__(
        self,
        model: Model,
        hover: Hover,
        settings: ControllerSettings,
        owned: Sequence[int],
        reference: Sampled | None = None,
        obstacles: Sequence[Obstacle] = (),
    ) -> None:
        self.settings = settings
        self.regulation = Regulation(model, hover, settings, reference)
        self._actuation = Actuation.of(settings, model.system.N)
        self._tilts = state.tilt_indices(model.system.N)
        self._decision = Decision(model.system, settings, owned)
        self._program = Program(self._decision, self.cost, self.regulation.user_costs)
        self._course_program = CourseProgram(self._decision, obstacles)
        self._softening = Softening(self._decision, self._program.stack)
        self._course_softening = Softening(self._decision, self._course_program.stack)
        self._newest_softening = self._softening  # that of the program formed last

        # The model with the motor failures reported to `fail`, and without.
        self.model = model
        self._whole = model
        self._gone = frozenset[int]()  # UAVs without an agent
        self._off = frozenset[int]()  # UAVs without motors
        self._released = frozenset[int]()  # of these the ones whose rods have been released
        # Whether several agents keep the same constraint of the user: every one on states, and of those
        # on inputs the ones on UAVs of several agents.
        on_states = bool(settings.constraint) and bool(OwnStates(self._decision).texts)
        on_inputs = bool(settings.constraint) and OwnInputs(self._decision).is_shared
        self._shares_rows = on_states or on_inputs
        self._relaxation = self._relaxation_of(several_correct_the_same=self._shares_rows)

        self._at_hover: Jacobians | None = None
        # Derivatives of the newest step and their difference equation, used again while the derivatives
        # are the same read-only array, as those at hover.
        self._discretised: tuple[Array, Discrete] | None = None
        # Outputs along the trajectory of the newest prediction beyond their linearisation,
        # (N_p + 1, p); None where that prediction is not along a trajectory.
        self._curvature: Array | None = None

    @property
    def owned(self) -> tuple[int, ...]:
        """Owned UAVs, 0-based."""
        return self._decision.uavs

    @property
    def own(self) -> Places:
        """Positions of the inputs of the owned UAVs in u, (m_own,)."""
        return self._decision.own

    @property
    def cost(self) -> Cost:
        """The cost of the present team."""
        return self.regulation.current.cost

    def law(
        self, x0: Array, x_ref: Array, c: Array, forces: Array | None = None, start: int = 0
    ) -> FeedbackLaw | None:
        """Return the shared control law over a horizon, as `TeamLaw.over`."""
        return self.regulation.current.over(x0, x_ref, c, forces, start)

    def end(
        self, x0: Array, x_ref: Array, forces: Array | None = None, instant: int = 0
    ) -> CostToGo | None:
        """Return the cost after the horizon, as `TeamLaw.cost_to_go`."""
        return self.regulation.current.cost_to_go(x0, x_ref, forces, instant)

    def step(
        self,
        x0: Array,
        u0: Array,
        horizon: Horizon,
        forces: Array | None = None,
        ticks_since_start: int | None = None,
    ) -> StepResult:
        """Return the plan of one step; never raises for a problem without solution.

        Args:
            x0: State at the first step of the horizon, (n,); with motor lag [x, actual inputs], (n
                + m,).
            u0: Inputs in force just before it, all UAVs, (m,): linearisation point and origin of
                the rates.
            horizon: Announced inputs, reference and control law over the horizon.
            forces: Estimated external forces, inertial frame, N, and mass (`Model`); None without
                estimate.
            ticks_since_start: Since this controller began; soon after it w is larger in `conclude`.
        """
        law = horizon.law
        linear = self.linearise(x0, u0, forces)
        prediction = self.predict(linear, self.discretise(linear), horizon.U, law)
        qp = self.condense(linear, prediction, horizon.y_ref, law, horizon.end)
        return self.conclude(self.solve(qp), prediction, horizon.U, law, ticks_since_start)

    def linearise(self, x0: Array, u0: Array, forces: Array | None = None) -> Linear:
        """Linearise about x0, (n,), or [x, actual inputs], (n + m,), and u0, (m,), SI.

        With a shared control law and another `linearisation` than "present" f is taken at x0, but the
        derivatives are those at hover.
        Source: docs/equations.md (15), (35a), (37), (40), (55).
        """
        team_law = self.regulation.current
        settings = self.settings
        has_lag = settings.motor_lag_s > 0.0
        x = x0[: self.model.system.n]
        actual = x0[len(x) :] if has_lag else u0

        # u_target = u_hover + M_u F
        u_target = team_law.cost.u_target
        if forces is not None and settings.weights.penalised_input == "deviation":
            forces_at_rest = self.model.with_weight_of_mass_error(forces)
            u_target = u_target + team_law.target.M_u @ forces_at_rest

        if settings.linearisation == "present" or settings.prediction == "open_loop":
            expansion = self.model.linearise(x, actual, forces=forces)
        else:
            if self._at_hover is None:
                hover = team_law.hover
                self._at_hover = self.model.linearise(hover.x, hover.u).jacobians
                frozen(self._at_hover.values)
            f = self.model.derivative(x, actual, forces=forces)
            expansion = Linearisation(f=f, y=self.model.outputs(x), jacobians=self._at_hover)
        if has_lag:
            by_rates = self.model.system.commands_rates
            expansion = with_lag(expansion, actual, u0, settings.motor_lag_s, by_rates)
        return Linear(x0=x, z0=x0, u0=u0, model=expansion, u_target=u_target, forces=forces)

    def discretise(self, linear: Linear) -> Discrete:
        """Return the difference equation over the sampling period: docs/equations.md (16)-(17)."""
        period_s = self.settings.sampling_period_s
        if self.settings.discretisation == "euler":
            return euler(linear.model, period_s)

        # Derivatives at hover are the same read-only array at every step, with the same A and B. With
        # motor lag they are a new array, and A and B are computed at each step.
        values = linear.model.jacobians.values
        before = None
        if self._discretised is not None and not values.flags.writeable:
            values_before, discrete_before = self._discretised
            before = discrete_before if values is values_before else None
        discrete = zero_order_hold(linear.model, period_s, before)
        frozen(discrete.A, discrete.B)
        self._discretised = values, discrete
        return discrete

    def predict(
        self, linear: Linear, discrete: Discrete, U: Array, law: FeedbackLaw | None
    ) -> Prediction | Course:
        """Predict the team; valid until the next prediction, as is its QP.

        Source: docs/equations.md (22)-(24), (35)-(36), (73).
        """
        self._curvature = None
        if law is not None and law.gains is not None:
            return self._course_program.course(self.model, linear, law, law.gains)

        trajectory = None
        if law is not None and self.settings.linearisation == "along":
            trajectory = self._followed(linear, law)
        if trajectory is not None:
            # h(x_bar) - y0 - C (x_bar - x0), (35a)
            C = linear.model.C
            outputs = self.model.outputs_along(trajectory.Z[:, : self.model.system.n])
            self._curvature = outputs - linear.model.y - (trajectory.Z - linear.z0) @ C.T
        return self._program.predict(linear, discrete, U, law, trajectory)

    def _followed(self, linear: Linear, law: FeedbackLaw) -> Rollout | None:
        """Return the trajectory of the nonlinear model under the law, unless it tilts too far."""
        trajectory = rollout(self.model, self._actuation, linear.z0, law, linear.forces)
        tilt = np.abs(trajectory.Z.take(self._tilts, axis=1)).max()
        if tilt < _STEEPEST and all_finite(trajectory.Z):
            return trajectory
        return None

    def condense(
        self,
        linear: Linear,
        prediction: Prediction | Course,
        y_ref: Array,
        law: FeedbackLaw | None = None,
        end: CostToGo | None = None,
    ) -> QP:
        """Return the QP in the scaled decision and the slacks; arguments as those of `step`.

        Source: docs/equations.md (22)-(30), (48), (74).
        """
        if isinstance(prediction, Course):
            self._newest_softening = self._course_softening
            return self._course_program.program(prediction)
        self._newest_softening = self._softening
        if self._curvature is not None:
            y_ref = y_ref - self._curvature
        return self._program.condense(linear, prediction, y_ref, law, end)

    def solve(self, qp: QP) -> Solution:
        """Solve by the chosen solver, or by the other one when that fails.

        Where hard constraints of the user have no solution, return that of the newest program with
        them softened, and their violations. Source: docs/equations.md (30e).
        """
        any_rows = bool(self.settings.constraint)
        solution = solve(qp, self.settings.solver, any_rows=any_rows)
        softening = self._newest_softening
        if solution.status != "infeasible" or not softening.texts:
            return solution
        softened = solve(softening.softened(qp), self.settings.solver, any_rows=any_rows)
        if softened.status != "solved":
            return solution
        return msgspec.structs.replace(softened, violations=softening.violations(softened.z))

    def conclude(
        self,
        solution: Solution,
        prediction: Prediction | Course,
        U: Array,
        law: FeedbackLaw | None,
        ticks_since_start: int | None = None,
    ) -> StepResult:
        """Return w U* + (1 - w) U_previous; after a failure the previous plan: (30a), (36a).

        With a shared control law only the corrections are mixed. Soon after the start of an agent w
        is larger: 1 / (ticks + 1).
        """
        is_solved = solution.status == "solved"
        w = self._relaxation
        if ticks_since_start is not None:
            w = max(w, 1.0 / (ticks_since_start + 1))
        w = w if is_solved else 0.0
        size = self._decision.size
        z = solution.z[:size] if is_solved else np.zeros(size)

        if isinstance(prediction, Course):
            announced = prediction.law if law is None else law
            inputs, c = self._course_program.planned(self.model, prediction, announced, z, w)
        elif law is not None:
            inputs, c = self._program.relaxed(prediction, law, z, w)
        else:
            inputs = U[:, self.own]
            c = np.zeros((0, len(self.own)))
            if is_solved:
                # The solver meets the bounds to its tolerance; the plant's actuators have them
                # exactly.
                best = self._decision.clip(prediction.U_free + self._decision.inputs(z))
                inputs = self._decision.clip(w * best + (1.0 - w) * inputs)
        if all_finite(inputs) and within(c, LARGEST):
            return StepResult(U=inputs, c=c, solution=solution)
        return self.give_up(U, law, None if is_solved else solution)

    def give_up(
        self, U: Array, law: FeedbackLaw | None, solution: Solution | None = None
    ) -> StepResult:
        """Return the shifted previous plan, clipped; used when there is nothing to solve.

        `solution` says why; without it the result reports a QP whose numbers are out of range.
        """
        c = np.zeros((0, len(self.own))) if law is None else law.c[:, self.own]
        solution = solution or unsolved(0, 0, self.settings.solver)
        return StepResult(U=self._decision.clip(U[:, self.own]), c=c, solution=solution)

    def foreseen(self, prediction: Prediction | Course, inputs: Array) -> Array:
        """Return the inputs of all UAVs that follow given owned ones, within bounds, (N_p, m)."""
        U: Array = prediction.U_all.copy()
        if isinstance(prediction, Prediction):
            U += convolve(prediction.feedback, inputs - prediction.U_free)
        U[:, self.own] = inputs
        N = self.model.system.N
        return np.clip(U, self.settings.lower(N), self.settings.upper(N))

    def without(self, uavs: Collection[int], since: int | None = None) -> None:
        """Set the UAVs without an agent, 0-based; `since` as in `Regulation.form`."""
        self._gone = frozenset(uavs)
        # UAVs without agents obstruct the others: several agents correct the same distances, each
        # its share of them.
        self._relaxation = self._relaxation_of(
            several_correct_the_same=bool(uavs) or self._shares_rows
        )
        self._form(since)

    def _relaxation_of(self, *, several_correct_the_same: bool) -> float:
        """Return the relaxation: at most the share of owned UAVs where all correct the same."""
        if not several_correct_the_same or self.settings.prediction != "closed_loop":
            return self.settings.relaxation
        return min(self.settings.relaxation, len(self.owned) / self._whole.system.N)

    def fail(
        self, off: Collection[int], released: Collection[int], since: int | None = None
    ) -> None:
        """Set the UAVs without motors, 0-based, and of them the released ones: (50), (51)."""
        self._off = frozenset(off)
        self._released = frozenset(released)
        self.model = Model(self._whole.system, off, released) if off else self._whole
        for stack in (self._program.stack, self._course_program.stack):
            stack.fail(self.model.system, self._off)
        self._form(since)

    def _form(self, since: int | None) -> None:
        """Take the law and the cost of the present team."""
        self.regulation.form(self._gone, self._off, self._released, since=since)
        self._at_hover = None
        self._program.form(self.cost, self._gone)
