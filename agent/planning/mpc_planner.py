"""One tick's work of an agent: estimate, form the problem, solve it, negotiate, conclude."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from transport.agent.communication.event_triggered_sharing import Corrections, Sharing
from transport.agent.estimation.estimate_notes import is_due
from transport.agent.estimation.filter.belief import Belief
from transport.agent.estimation.team_estimate import Expected, TeamEstimate
from transport.agent.planning.hand_over_inputs import HandOver
from transport.agent.planning.step_problem import (
    StepProblem,
    horizon_start,
    integrated,
    step_problem,
)
from transport.agent.planning.step_report import (
    NO_AGE,
    StageTimes,
    numbers_note,
    step_plan,
    step_report,
)
from transport.agent.received import Received
from transport.agent.silence.failed_or_repeated_steps import Freshness
from transport.model.arrays import Array, frozen
from transport.model.physics.obstacles import Obstacle
from transport.model.state import input_indices
from transport.mpc.controller import Controller, Horizon, StepResult
from transport.mpc.program.constraints.softened_user_constraints import softened_problem
from transport.mpc.program.quadratic_program import unsolved
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.messages import Message, Plan, StepReport
from transport.protocol.wire.outbox import Outbox

# Solver in the reports of steps without a QP: all UAVs of the agent act wholly alone.
_ALONE = "alone"
# In reports: no number.
_NO_NUMBER = -1.0
_NO_FORCE = np.zeros(3)
frozen(_NO_FORCE)


@dataclass(slots=True, kw_only=True)
class MpcStep:
    """An open tick: its problem, and the newest result."""

    received: Received
    uav_states: Array  # states or measurements of the owned UAVs for the plan, (owned, 12 or 80)
    start_tick: int  # first tick that the plan is for
    problem: StepProblem
    negotiation: int
    result: StepResult | None = None


class Planner:
    """Estimator and controller of one agent, 1-based; the stopwatch counts ns of a steady clock."""

    def __init__(self, setup: TeamRun, agent: int, stopwatch: Callable[[], int]) -> None:
        self._setup = setup
        self._agent = agent
        self._stopwatch = stopwatch
        self._owned = setup.owned[agent - 1]
        self._controller = Controller(
            setup.model,
            setup.hover,
            setup.settings,
            self._owned,
            setup.reference.sampled,
            setup.obstacles,
        )
        self._team = TeamEstimate(setup, agent, self._controller)
        self._reset()

    def _reset(self) -> None:
        settings = self._setup.settings
        uavs = len(self._owned)
        self._sharing = Sharing(self._setup.settings, settings.lower(uavs), settings.upper(uavs))
        self._freshness = Freshness()
        self._times = StageTimes(self._stopwatch)
        self._handover = HandOver(self._setup, self._team, self._owned)
        self._noted_resets = set[int]()  # ticks at which the filter began anew, as far as noted

    def restart(self) -> None:
        """Reset for a new start in the run; the controller keeps its state."""
        self._team.restart()
        self._reset()

    def follow(self, setup: TeamRun) -> None:
        """Follow the reference of the run with a further target, from that target's tick on.

        Its plan is shared, as it carries the target. The other parts that `_reset` makes read nothing
        that a target changes.
        """
        self._sharing.renew()
        self._setup = setup
        self._team.follow(setup)

    @property
    def share_alone(self) -> float:
        """Share, 0 to 1, of the law alone in the newest inputs."""
        return self._handover.share

    def see(self, seen: tuple[Obstacle, ...]) -> None:
        """Do nothing: the path keeps clear of what the agent sees."""

    def announce(self) -> None:
        """Share the next plan."""
        self._sharing.renew()

    @property
    def belief(self) -> Belief | None:
        """Newest estimate with its covariance; None without one."""
        return self._team.estimator.belief

    def warm_up(self) -> None:
        """Compute a step and discard it: the first step of the run is not slower then."""
        controller = self._controller
        hover = self._setup.hover
        settings = self._setup.settings
        forces = self._team.forces
        x0 = np.concatenate([hover.x, hover.u]) if settings.motor_lag_s > 0.0 else hover.x
        U = np.tile(hover.u, (settings.horizon, 1))
        x_ref = np.tile(hover.x, (settings.horizon, 1))
        y_ref = np.tile(self._setup.model.outputs(hover.x), (settings.horizon + 1, 1))

        law = controller.law(x0, x_ref, np.zeros_like(U), forces)
        end = controller.end(x0, hover.x, forces)
        controller.step(x0, hover.u, Horizon(U=U, y_ref=y_ref, law=law, end=end), forces)
        integrated(settings, controller.model, x0, hover.u, None)
        controller.regulation.fail_safe.warm_up()

    def begin(self, received: Received) -> MpcStep:
        """Estimate the state at a tick and form the problem that follows from it."""
        self._times.begin(received.started_ns)
        k = received.tick
        x = self._team.update(received)
        self._handover.advance(k)
        start = horizon_start(self._setup, self._controller, self._team, k, x)
        problem = step_problem(self._setup, self._controller, self._team, start, k, self._times)
        return MpcStep(
            received=received,
            uav_states=self._team.estimator.reported(k, x),
            start_tick=start.tick,
            problem=problem,
            negotiation=self._setup.settings.negotiation_iterations,
        )

    def plan(self, step: MpcStep, out: Outbox, publish_ns: int) -> list[Message]:
        """Solve a step's problem; return a proposal, or at the end the tick's plan and report.

        The step's `negotiation` counts down to 0; the last messages took `publish_ns` to publish.
        """
        acts_alone = self._handover.share == 1.0
        result = self._shifted(step) if acts_alone else self._solved(step)
        step.result = result
        step.negotiation -= 1
        if step.negotiation > 0:
            return [self._plan(step, result, out)]

        result = self._handed_over(step, result)
        self._times.lap("solve")
        plan = self._plan(step, result, out)
        # The times end with the plan: the report is of them.
        self._team.announced.add(plan)
        self._freshness.conclude(plan.tick, is_solved=plan.status == "solved")
        self._times.conclude(publish_ns)
        report = self._report(step, result, out)
        k = step.received.tick
        notes = self._notes(k, out)
        softened = [
            numbers_note(k, self._agent, {"violation": violation}, out, softened_problem(text))
            for text, violation in result.solution.violations.items()
        ]
        self._times.resume()
        return [*notes, *softened, plan, report]

    def _plan(self, step: MpcStep, result: StepResult, out: Outbox) -> Plan:
        """Return the plan of a result; the last one of a tick is shared if the others need it."""
        received = step.received
        corrections = Corrections(
            tick=received.tick,
            start=step.start_tick,
            c=result.c,
            roster=received.measurement.roster,
            alone=self._handover.share,
        )
        # `decide` is asked once a tick: the others assume a shared plan from then on.
        is_last = step.negotiation == 0
        is_shared = not is_last or self._sharing.decide(corrections)
        return step_plan(
            received.tick,
            self._agent,
            out,
            self._setup,
            uav_states=step.uav_states,
            inputs=result.U,
            corrections=result.c,
            status=result.solution.status,
            negotiation=step.negotiation,
            shared=is_shared,
            alone=self._handover.share,
            stale=self._freshness.age(received.tick, is_solved=result.solution.status == "solved"),
        )

    def _handed_over(self, step: MpcStep, result: StepResult) -> StepResult:
        """Return the result with inputs between the team's and those of the UAVs alone, (32d).

        The corrections stay those to the team's law: receivers mix that law with the one alone, by
        the share in the plan (32c).
        """
        k = step.received.tick
        U = self._handover.inputs(k, step.start_tick, step.problem.linear, result.U)
        if U is result.U:
            return result
        return msgspec.structs.replace(result, U=U, c=result.c[: len(U)])

    def adopt(self, step: MpcStep, proposals: Sequence[Plan]) -> None:
        """Take the others' proposals and the own one into the next iteration of the negotiation.

        U = [u_1, ..., u_M] of iteration r - 1, and with a shared control law c likewise: (47). The
        columns of an agent stay as they are where its proposal covers another number of steps, as
        that of an agent in another language may, or has no corrections.
        """
        problem = step.problem
        U = problem.U.copy()
        law = (
            None
            if problem.law is None
            else msgspec.structs.replace(problem.law, c=problem.law.c.copy())
        )

        sequences = [(plan.agent, plan.inputs, plan.corrections) for plan in proposals]
        if step.result is not None:
            sequences.append((self._agent, step.result.U, step.result.c))
        for agent, inputs, corrections in sequences:
            columns = input_indices(self._setup.owned[agent - 1])
            if len(inputs) == len(U):
                U[:, columns] = inputs
            if law is not None and len(corrections) == len(law.c):
                law.c[:, columns] = corrections
        step.problem = msgspec.structs.replace(problem, U=U, law=law)

    def end(self, tick: int, out: Outbox) -> list[Message]:  # noqa: ARG002
        """Return nothing: this controller has nothing to end with the run."""
        return []

    def _solved(self, step: MpcStep) -> StepResult:
        """Return the result of a problem: predict, condense, solve and conclude."""
        controller = self._controller
        problem = step.problem
        self._times.resume()
        if problem.discrete is None:
            result = controller.give_up(problem.U, problem.law)
            self._times.lap("condense")
            return result

        with np.errstate(over="ignore", invalid="ignore"):  # the solver refuses such numbers
            # Free response of the state, and its response to the decision: (22)-(24), (35), (36).
            prediction = controller.predict(
                problem.linear, problem.discrete, problem.U, problem.law
            )
            # min 1/2 z' H z + g' z, row_lower <= A z <= row_upper: (25)-(30).
            qp = controller.condense(
                problem.linear, prediction, problem.y_ref, problem.law, problem.end
            )
            self._times.lap("condense")

            solution = controller.solve(qp)
            # U = w U* + (1 - w) U_shift: (30a); with a shared control law the corrections are mixed
            # instead: (36a).
            result = controller.conclude(
                solution, prediction, problem.U, problem.law, step.received.ticks_since_start
            )
            self._times.lap("solve")

        # The prediction of the team's motion (32b) takes these inputs, from before a hand-over.
        if problem.law is not None:
            self._team.expected = Expected(
                start=step.start_tick, prediction=prediction, inputs=result.U
            )
        return result

    def _shifted(self, step: MpcStep) -> StepResult:
        """Return the shifted previous plan without a solve: all UAVs of the agent act wholly alone.

        `_handed_over` replaces its inputs, and cuts its corrections to `steps_alone` entries.
        """
        problem = step.problem
        self._times.resume()
        no_qp = unsolved(n=0, rows=0, solver=_ALONE)
        on_purpose = msgspec.structs.replace(
            no_qp, status="solved"
        )  # no QP was due: summaries count no failure
        result = self._controller.give_up(problem.U, problem.law, on_purpose)
        self._team.expected = None
        self._times.lap("solve")
        return result

    def _notes(self, tick: int, out: Outbox) -> list[Message]:
        """Return the numbers of the estimator for the log, if it has any and they are due."""
        notes = self._resets(tick, out)
        if not is_due(tick, self._setup.settings.sampling_period_s):
            return notes
        numbers = self._team.estimator.log_numbers()
        if not numbers:
            return notes
        return [*notes, numbers_note(tick, self._agent, numbers, out)]

    def _resets(self, tick: int, out: Outbox) -> list[Message]:
        """Return a note if the filter has begun anew since the last step."""
        new = self._team.estimator.resets - self._noted_resets
        if not new:
            return []
        self._noted_resets |= new
        problem = (
            "filter: estimate out of range or denied by measurements, begun anew about the "
            f"reference at tick {max(new)}"
        )
        return [numbers_note(tick, self._agent, {}, out, problem)]

    def _report(self, step: MpcStep, result: StepResult, out: Outbox) -> StepReport:
        """Return the report of a step."""
        k = step.received.tick
        team = self._team
        solution = result.solution
        worst = solution.residuals.worst
        measured = team.estimator.new_states.measured
        newest = [team.announced.plans.newest(agent, before=k) for agent in team.peers]
        force = _NO_FORCE
        if team.forces is not None:
            force = self._controller.model.with_weight_of_mass_error(team.forces)[:3]
        return step_report(
            step.received,
            self._agent,
            out,
            status=solution.status,
            solver=solution.solver,
            fallback=solution.fallback,
            iterations=solution.iterations,
            residual=worst if math.isfinite(worst) else _NO_NUMBER,
            peers=team.peers,
            plan_ages=tuple(NO_AGE if plan is None else k - plan.solved_tick for plan in newest),
            state_ages=tuple(team.estimator.new_states.age(agent, k) for agent in team.peers),
            measurement_age=NO_AGE if measured < 0 else k - measured,
            force=force,
            times_ns=self._times.ns,
        )
