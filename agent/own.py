"""A controller of the user: a class named in the scenario plans the inputs of an agent's UAVs.

The class takes the place of estimator, prediction and program; docs/bring-your-own.md has its
methods. A step that raises, or that returns anything but inputs, is data: the shifted previous plan
is applied, as after a solve without solution, and a `Note` says why.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from transport.agent.own_returned import Returned, checked, converted
from transport.agent.own_run import run_of
from transport.agent.received import Received
from transport.agent.step import numbers_note, step_report
from transport.model.arrays import Array
from transport.model.state import StateView, input_indices
from transport.protocol.scenario.errors import ScenarioError
from transport.protocol.scenario.own_class import (
    OwnClassError,
    made,
    own_class,
    told,
    version_of,
)
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import STAGES, Measurement, Message, Plan, PlanStatus
from transport.protocol.wire.node import Outbox

PROJECT = "mpc"  # the controller of the project
OF_PROJECT = PROJECT, "alone"
METHODS = ("start", "step", "stop")  # of a class of the user


def checked_controller(setup: Setup) -> str:
    """Return name and version of the controller after starting it once.

    Raises: ScenarioError: it cannot be used.
    """
    name = setup.scenario.agents.controller
    if name in OF_PROJECT:
        return name
    OwnPlanner(setup, 1, lambda: 0).stop()
    return f"{name} {controller_version(name)}".rstrip()


def controller_version(name: str) -> str:
    """Return the version of a controller, empty for that of the project.

    Raises: OwnClassError: it is not found.
    """
    return "" if name in OF_PROJECT else version_of(own_class(name))


@dataclass(slots=True, kw_only=True)
class OwnStep:
    """An open tick of a controller of the user; it has no negotiation before its plan."""

    received: Received
    start: int  # first tick that the plan is for
    negotiation: int = 1  # exchanges of plans still to come


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Result of a tick: inputs of the class, or the shifted previous ones with the reason."""

    inputs: Array  # (rows, 4 owned)
    numbers: Mapping[str, float]  # for the log, by name
    status: PlanStatus
    problem: str = ""  # why the step failed; empty if it did not


@dataclass(frozen=True, slots=True, kw_only=True)
class Previous:
    """Inputs of the last plan."""

    start: int  # their first tick
    inputs: Array  # (rows, 4 owned)

    def from_tick(self, tick: int) -> Array:
        """Return the inputs from a tick on; the last row is held."""
        skipped = min(tick - self.start, len(self.inputs) - 1)
        return self.inputs[skipped:]


class OwnPlanner:
    """Planner of an agent, 1-based, whose controller is a class of the user.

    Raises: ScenarioError: the class cannot be used.
    """

    belief = None  # the class has its own estimator, if any

    def __init__(self, setup: Setup, agent: int, stopwatch: Callable[[], int]) -> None:
        self._setup = setup
        self._agent = agent
        self._stopwatch = stopwatch
        self._name = setup.scenario.agents.controller
        self._owned = setup.owned[agent - 1]
        self._peers = tuple(other for other in setup.agents if other != agent)
        self._controller: Any = None
        self.restart()
        if self._problem:
            raise ScenarioError(setup.scenario.name, "agents.controller", self._problem)

    def restart(self) -> None:
        """Start a new object of the class, without knowledge of the run so far."""
        self.stop()
        self._run = run_of(self._setup, self._agent)
        self._measurement: Measurement | None = None  # the newest that is usable
        self._newest: dict[int, int] = {}  # tick of the newest plan used, by agent
        hover = self._setup.hover.u[input_indices(self._owned)]
        self._previous = Previous(start=0, inputs=hover[None])
        self._idle_since_ns = self._stopwatch()
        self._problem = self._start()  # why the class did not start

    def _start(self) -> str:
        """Start a new object of the class; return why that failed, empty if it did not."""
        try:
            controller = made(own_class(self._name), METHODS)
            with told("start"):
                controller.start(self._run)
        except OwnClassError as error:
            return str(error)
        self._controller = controller
        return ""

    def stop(self) -> str:
        """End the run for the class, once; return why that failed, empty if it did not."""
        controller = self._controller
        self._controller = None
        if controller is None:
            return ""
        try:
            with told("stop"):
                controller.stop()
        except OwnClassError as error:
            return str(error)
        return ""

    def follow(self, setup: Setup) -> None:
        """Let the class have the reference with a further target, from that target's tick on."""
        self._setup = setup
        self._run.follow(setup)

    def warm_up(self) -> None:
        """Do nothing: the class prepares itself when it starts."""

    def begin(self, received: Received) -> OwnStep:
        """Take in what has arrived at a tick."""
        if received.measurements:
            newest = max(received.measurements, key=lambda measurement: measurement.tick)
            self._measurement = newest
        for plan in received.plans:
            self._newest[plan.agent] = max(plan.tick, self._newest.get(plan.agent, -1))

        self._run.tick = received.tick
        self._run.agents = tuple(sorted(received.agents))
        self._run.failed = tuple(sorted(received.off))
        return OwnStep(received=received, start=received.tick + self._run.delay)

    def plan(self, step: OwnStep, out: Outbox, publish_ns: int) -> list[Message]:
        """Return the tick's plan and report, and a note with numbers or a failure, if any."""
        step.negotiation = 0
        begun_ns = self._stopwatch()
        outcome = self._outcome(step)
        self._previous = Previous(start=step.start, inputs=outcome.inputs)
        plan = self._plan(step, outcome, out)

        received = step.received
        now_ns = self._stopwatch()
        times_ns = {
            **dict.fromkeys(STAGES, 0),
            "wait": received.started_ns - self._idle_since_ns,
            "publish": publish_ns,
            "solve": now_ns - begun_ns,
            "total": now_ns - received.started_ns,
        }
        report = self._report(received, outcome.status, times_ns, out)
        notes = self._notes(received.tick, outcome.problem, outcome.numbers, out)
        self._idle_since_ns = self._stopwatch()
        return [*notes, plan, report]

    def adopt(self, step: OwnStep, proposals: Sequence[Plan]) -> None:
        """Do nothing: there is no negotiation."""

    def end(self, tick: int, out: Outbox) -> list[Message]:
        """End the run for the class; return a note if that failed."""
        return self._notes(tick, self.stop(), {}, out)

    def _outcome(self, step: OwnStep) -> Outcome:
        """Return the inputs of the class; the shifted previous plan if it has none."""
        shifted = self._previous.from_tick(step.start)
        try:
            if self._controller is None:
                raise OwnClassError(self._problem)
            if self._measurement is None:
                return Outcome(inputs=shifted, numbers={}, status="solved")
            returned = self._returned(self._measurement, step.received.plans)
        except OwnClassError as error:
            return Outcome(inputs=shifted, numbers={}, status="numerical", problem=str(error))
        return Outcome(inputs=returned.inputs, numbers=returned.numbers, status="solved")

    def _returned(self, measurement: Measurement, plans: Sequence[Plan]) -> Returned:
        """Return what a step of the class returns, checked. Raises: OwnClassError: it fails."""
        with told("step"):
            returned = converted(self._controller.step(measurement, plans))
        return checked(returned, self._run)

    def _plan(self, step: OwnStep, outcome: Outcome, out: Outbox) -> Plan:
        """Return the plan of a tick."""
        measured = self._measurement
        if measured is None:
            x_ref = self._run.reference(step.received.tick)
            states = StateView(x_ref).uavs[list(self._owned)]
        else:
            states = measured.uav_states
        return out.stamp(
            Plan,
            tick=step.received.tick,
            agent=self._agent,
            start_tick=step.start,
            uavs=tuple(uav + 1 for uav in self._owned),
            uav_states=states,
            inputs=outcome.inputs,
            corrections=np.zeros((0, outcome.inputs.shape[1])),
            status=outcome.status,
            negotiation=0,
            shared=True,
        )

    def _report(
        self, received: Received, status: PlanStatus, times_ns: Mapping[str, int], out: Outbox
    ) -> Message:
        """Return the report of a tick."""
        k = received.tick
        measured = self._measurement
        ages = tuple(k - self._newest[peer] if peer in self._newest else -1 for peer in self._peers)
        return step_report(
            received,
            self._agent,
            out,
            status=status,
            solver=self._name,
            fallback=False,
            iterations=0,
            residual=-1.0,
            force=np.zeros(3),
            peers=self._peers,
            plan_ages=ages,
            state_ages=ages,
            measurement_age=-1 if measured is None else k - measured.tick,
            times_ns=times_ns,
        )

    def _notes(
        self, tick: int, problem: str, numbers: Mapping[str, float], out: Outbox
    ) -> list[Message]:
        """Return a note with numbers for the log or a problem; none without both."""
        if not problem and not numbers:
            return []
        text = f"controller {self._name}: {problem}" if problem else ""
        return [numbers_note(tick, self._agent, numbers, out, text)]
