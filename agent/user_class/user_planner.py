"""A controller of the user: a class named in the scenario plans the inputs of an agent's UAVs.

The class takes the place of estimator, prediction and program; docs/own-controller.md has its
methods. A step that raises, or that returns anything but inputs, is data: the shifted previous plan
is applied, as after a solve without solution, and a `Note` says why. So it does where the class returns
the same for long although its measurements change. Plans say how old such inputs are
(`agent.silence.failed_or_repeated_steps`).
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import prod

import numpy as np
from msgspec.structs import replace

from transport.agent.estimation.received_states import Reports, by_uav
from transport.agent.planning.step_report import numbers_note, step_plan, step_report
from transport.agent.received import Received
from transport.agent.silence.failed_or_repeated_steps import Freshness, Repetition
from transport.agent.user_class.returned_values import Outcome
from transport.agent.user_class.run_for_user import run_of
from transport.agent.user_class.user_object import OwnObject
from transport.model.arrays import Array
from transport.model.physics.obstacles import Obstacle
from transport.model.state import REPORTS, StateView, input_indices
from transport.mpc.alone.fail_safe import PLAYED_S
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.scenario.user_class.user_errors import OwnClassError
from transport.protocol.wire.messages import STAGES, Measurement, Message, Note, Plan
from transport.protocol.wire.outbox import Outbox

_NO_DATA = np.zeros(0)
_UNCHANGED = (
    f"the inputs have been the same for more than {PLAYED_S:g} s while the measurements changed: "
    "suspicious, the UAVs fly as without plans until they change"
)


@dataclass(slots=True, kw_only=True)
class OwnStep:
    """An open tick of a controller of the user."""

    received: Received
    start_tick: int  # first tick that the plan is for
    negotiation: int
    plans: Sequence[Plan]  # of the others, for the next call
    iteration: int = 0  # exchanges so far
    outcome: Outcome | None = None  # of the last call
    # Why data of others were refused, and the time of the calls so far.
    refused: list[str] = field(default_factory=list)
    estimate_ns: int = 0
    solve_ns: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Previous:
    """Inputs of the last plan."""

    start: int  # their first tick
    inputs: Array  # (rows, 4 owned)

    def from_tick(self, tick: int) -> Array:
        """Return as many inputs from a tick on; the last row is held."""
        last = len(self.inputs) - 1
        rows = np.arange(len(self.inputs)) + tick - self.start
        return self.inputs[np.minimum(rows, last)]


class OwnPlanner:
    """Planner of an agent, 1-based, whose controller is a class of the user.

    Raises: ScenarioError: the class cannot be used.
    """

    belief = None  # the filter of the class, if any, is not shown

    def __init__(self, setup: TeamRun, agent: int, stopwatch: Callable[[], int]) -> None:
        self._setup = setup
        self._agent = agent
        self._stopwatch = stopwatch
        self._name = setup.known.controllers[agent - 1]
        self._iterations = setup.settings.negotiation_iterations
        self._owned = setup.owned[agent - 1]
        self._peers = tuple(other for other in setup.agents if other != agent)
        self._object: OwnObject | None = None
        self.restart()
        if self._problem:
            raise ScenarioError(setup.rules.name, "agents.controller", self._problem)

    @property
    def data_numbers(self) -> int:
        """Return how many numbers of own data each plan has."""
        shape = self._run.data_shape
        return 0 if shape is None else prod(shape)

    def restart(self) -> None:
        """Start a new object of the class, without knowledge of the run so far."""
        self.stop()
        self._run = run_of(self._setup, self._agent)
        self._measurement: Measurement | None = None  # the newest that is usable
        self._newest: dict[int, Plan] = {}  # newest plan used, by agent
        self._sensed = Reports()  # own measurements of the last ticks
        self._freshness = Freshness()
        self._repetition = Repetition(self._setup.settings.sampling_period_s)
        self._told_roster = -1  # version under which a plan was last sent to the others
        hover = self._setup.hover.u[input_indices(self._owned)]
        self._previous = Previous(start=0, inputs=hover[None])
        self._idle_since_ns = self._stopwatch()
        self._problem = self._start()  # why the class did not start

    def _start(self) -> str:
        """Start a new object of the class; return why that failed, empty if it did not."""
        try:
            self._object = OwnObject(self._name, self._run, is_negotiating=self._iterations > 1)
        except OwnClassError as error:
            return str(error)
        return ""

    def stop(self) -> str:
        """End the run for the class, once; return why that failed, empty if it did not."""
        controller = self._object
        self._object = None
        if controller is None:
            return ""
        try:
            controller.stop()
        except OwnClassError as error:
            return str(error)
        return ""

    def follow(self, setup: TeamRun) -> None:
        """Let the class have the reference with a further target, from that target's tick on."""
        self._setup = setup
        self.announce()
        self._run.follow(setup)

    def see(self, seen: tuple[Obstacle, ...]) -> None:
        """Let the class know what UAVs of this agent have seen."""
        self._run.see(seen)

    @property
    def share_alone(self) -> float:
        """0: silence does not change what it does."""
        return 0.0

    def announce(self) -> None:
        """Send the next plan to the others."""
        self._told_roster = -1

    def warm_up(self) -> None:
        """Do nothing: the class prepares itself when it starts."""

    # A tick: begin, then plan and adopt in turns.

    def begin(self, received: Received) -> OwnStep:
        """Take in what has arrived at a tick."""
        begun_ns = self._stopwatch()
        for measurement in received.measurements:
            # A link with jitter may deliver an older one after a newer one.
            if self._measurement is None or measurement.tick > self._measurement.tick:
                self._measurement = measurement
            for uav, report in by_uav(measurement):
                self._sensed.tell(measurement.tick, uav, report)
        self._sensed.forget_before(received.tick - REPORTS)
        for plan in received.plans:
            newest = self._newest.get(plan.agent)
            if newest is None or plan.tick > newest.tick:
                self._newest[plan.agent] = plan

        self._run.begin(received, must_send=received.measurement.roster != self._told_roster)
        step = OwnStep(
            received=received,
            start_tick=received.tick + self._run.delay,
            negotiation=self._iterations,
            plans=(),
        )
        step.plans = tuple(self._shaped(received.plans, step.refused))
        step.estimate_ns = self._stopwatch() - begun_ns
        return step

    def plan(self, step: OwnStep, out: Outbox, publish_ns: int) -> list[Message]:
        """Return a proposal, or at the end of the tick notes, if any, with its plan and report."""
        begun_ns = self._stopwatch()
        if step.outcome is None or not step.outcome.problem:
            step.outcome = self._outcome(step)
        step.negotiation -= 1
        outcome = step.outcome
        step.solve_ns += self._stopwatch() - begun_ns

        is_last = step.negotiation == 0
        if is_last:
            outcome = step.outcome = self._without_repetition(step, outcome)
        is_shared = not is_last or outcome.send or self._run.must_send
        plan = self._plan(step, outcome, out, is_shared=is_shared)
        if not is_last:
            return [plan]

        self._conclude(step, plan)
        report = self._report(step, publish_ns, out)
        notes = list(self._notes(step, out))
        self._idle_since_ns = self._stopwatch()
        return [*notes, plan, report]

    def adopt(self, step: OwnStep, proposals: Sequence[Plan]) -> None:
        """Take the others' proposals into the next iteration of the negotiation."""
        step.iteration += 1
        step.plans = tuple(self._shaped(proposals, step.refused))

    def end(self, tick: int, out: Outbox) -> list[Message]:
        """End the run for the class; return a note if that failed."""
        problem = self.stop()
        return [self._note(tick, problem, {}, out)] if problem else []

    def _shaped(self, plans: Sequence[Plan], refused: list[str]) -> Iterator[Plan]:
        """Yield plans with their data in the shape that the own class has declared.

        Data of another number are refused: the plan has none then.
        """
        shape = self._run.data_shape
        numbers = self.data_numbers
        for plan in plans:
            count = len(plan.data)
            if count == 0:
                yield plan
            elif shape is not None and count == numbers:
                yield replace(plan, data=plan.data.reshape(shape))
            else:
                expected = "no data" if shape is None else f"data of shape {shape}"
                refused.append(f"plan of {plan.sender}: expected {expected}, got {count} numbers")
                yield replace(plan, data=_NO_DATA)

    def _outcome(self, step: OwnStep) -> Outcome:
        """Return the result of the class; the shifted previous plan if it has none."""
        shifted = self._previous.from_tick(step.start_tick)
        if self._measurement is None:
            return Outcome(inputs=shifted)
        try:
            if self._object is None:
                raise OwnClassError(self._problem)
            if step.iteration == 0:
                return self._object.step(self._measurement, step.plans)
            return self._object.negotiate(step.iteration, step.plans)
        except OwnClassError as error:
            return Outcome(inputs=shifted, status="numerical", problem=str(error))

    def _without_repetition(self, step: OwnStep, outcome: Outcome) -> Outcome:
        """Return the last outcome of a tick, with the time for which the class has repeated itself."""
        measured = self._measurement
        if outcome.asked is None or measured is None:
            return outcome
        unchanged = self._repetition.age(step.received.tick, outcome.asked, measured)
        if not unchanged:
            return outcome
        return dataclasses.replace(
            outcome, status="unchanged", unchanged=unchanged, problem=_UNCHANGED
        )

    def _conclude(self, step: OwnStep, plan: Plan) -> None:
        """Remember the plan of a tick."""
        self._freshness.conclude(plan.tick, is_solved=plan.status == "solved")
        self._previous = Previous(start=step.start_tick, inputs=plan.inputs)
        self._run.announce(plan)
        if plan.shared:
            self._told_roster = step.received.measurement.roster

    def _plan(self, step: OwnStep, outcome: Outcome, out: Outbox, *, is_shared: bool) -> Plan:
        """Return the plan, or proposal, of an outcome."""
        tick = step.received.tick
        stale = self._freshness.age(tick, is_solved=outcome.status == "solved")
        return step_plan(
            tick,
            self._agent,
            out,
            self._setup,
            uav_states=self._uav_states(tick),
            inputs=outcome.inputs,
            status=outcome.status,
            negotiation=step.negotiation,
            shared=is_shared,
            data=outcome.data,
            stale=max(stale, outcome.unchanged),
        )

    def _uav_states(self, tick: int) -> Array:
        """Return the measured states of the own UAVs, (owned, 12), or of their sensors, (owned, 80).

        Before the first measurement the reference is known alone.
        """
        if self._setup.sensors.vehicle:
            return self._sensed.rows(tick, self._owned)
        if self._measurement is not None:
            return self._measurement.uav_states
        return StateView(self._run.reference(tick)).uavs[list(self._owned)]

    def _report(self, step: OwnStep, publish_ns: int, out: Outbox) -> Message:
        """Return the report of a tick."""
        received = step.received
        k = received.tick
        now_ns = self._stopwatch()
        times_ns = {
            **dict.fromkeys(STAGES, 0),
            "wait": received.started_ns - self._idle_since_ns,
            "publish": publish_ns,
            "estimate": step.estimate_ns,
            "solve": step.solve_ns,
            "total": now_ns - received.started_ns,
        }
        measured = self._measurement
        newest = [self._newest.get(peer) for peer in self._peers]
        return step_report(
            received,
            self._agent,
            out,
            status="solved" if step.outcome is None else step.outcome.status,
            solver=self._name,
            fallback=False,
            iterations=0,
            residual=-1.0,
            force=np.zeros(3),
            peers=self._peers,
            plan_ages=tuple(-1 if plan is None else k - plan.solved_tick for plan in newest),
            state_ages=tuple(-1 if plan is None else k - plan.tick for plan in newest),
            measurement_age=-1 if measured is None else k - measured.tick,
            times_ns=times_ns,
        )

    def _notes(self, step: OwnStep, out: Outbox) -> Iterator[Note]:
        """Yield a note with the numbers or the failure of a tick, and one for refused data."""
        outcome = step.outcome
        tick = step.received.tick
        for problem in dict.fromkeys(step.refused):
            yield self._note(tick, problem, {}, out)
        if outcome is not None and (outcome.problem or outcome.numbers):
            yield self._note(tick, outcome.problem, outcome.numbers, out)

    def _note(self, tick: int, problem: str, numbers: Mapping[str, float], out: Outbox) -> Note:
        """Return a note with numbers for the log or a problem."""
        text = f"controller {self._name}: {problem}" if problem else ""
        return numbers_note(tick, self._agent, numbers, out, text)
