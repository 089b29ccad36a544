"""A controller of the user: a class named in the scenario plans the inputs of an agent's UAVs.

The class takes the place of estimator, prediction and program; docs/bring-your-own.md has its methods. A step that
raises, or that returns anything but inputs, is data: the shifted previous plan is applied, as after a solve without
solution, and a `Note` says why.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.step import step_report
from agent.team_estimate import Known
from model.arrays import Array
from model.linearisation import Model
from model.parameters import System
from model.state import StateView, input_indices
from protocol.scenario.errors import ScenarioError
from protocol.scenario.own_class import OwnClassError, made, own_class, real_array, told, version_of
from protocol.scenario.setup import Setup
from protocol.wire.messages import MAX_NAME, MAX_NAMES, STAGES, Measurement, Message, Note, Plan, PlanStatus
from protocol.wire.node import Outbox

PROJECT = "mpc"  # the controller of the project
OF_PROJECT = PROJECT, "alone"


@dataclass(slots=True, kw_only=True)
class Run:
    """Team and run as a controller of the user knows them: the parameters that the scenario states, not the plant's.

    UAVs are numbered from 0, as in arrays, agents from 1. `tick`, `agents` and `failed` are renewed before each step.
    """

    agent: int  # of this object
    owned: tuple[int, ...]  # its UAVs
    system: System  # masses, inertias, attachment points and rod lengths; N is `system.N`
    model: Model  # equations of motion; `model.linearise(x, u)` has the derivatives
    x_hover: Array  # state of the hover at the origin, (12 + 12 N,)
    u_hover: Array  # inputs of the hover, (4 N,), N and N m
    lower: Array  # smallest inputs of the owned UAVs, (4 owned,); inputs are clipped to them
    upper: Array  # largest ones
    period_s: float  # sampling period
    ticks: int  # sampling instants of the run
    horizon: int  # most rows of a plan
    delay: int  # ticks from the present one to the first that a plan acts at: 0, or 1 with clock.actuation "next_tick"
    seed: int  # of the run, for random numbers that are the same in every run of a scenario
    tick: int = 0  # the present one; a measurement may be older (`links.measurement`)
    agents: tuple[int, ...] = ()  # on the roster
    failed: tuple[int, ...] = ()  # UAVs whose motors are off
    _X_ref: Array

    def reference(self, tick: int) -> Array:
        """Return the reference state at a tick, (12 + 12 N,), held after the end of the maneuver."""
        return np.array(self._X_ref[min(tick, len(self._X_ref) - 1)])


def checked_controller(setup: Setup) -> str:
    """Return name and version of the controller after starting it once. Raises: ScenarioError: it cannot be used."""
    name = setup.scenario.agents.controller
    if name in OF_PROJECT:
        return name
    OwnPlanner(setup, 1, lambda: 0).stop()
    return f"{name} {controller_version(name)}".rstrip()


def controller_version(name: str) -> str:
    """Return the version of a controller, empty for those of the project. Raises: OwnClassError: it is not found."""
    return "" if name in OF_PROJECT else version_of(own_class(name))


@dataclass(slots=True)
class OwnStep:
    """A tick of a controller of the user; it has no negotiation before its plan."""

    known: Known
    negotiation: int = 1


class OwnPlanner:
    """Planner of an agent, 1-based, whose controller is a class of the user; ScenarioError: it cannot be used."""

    def __init__(self, setup: Setup, agent: int, stopwatch: Callable[[], int]) -> None:
        self._setup, self._agent, self._stopwatch = setup, agent, stopwatch
        self._name, self._owned = setup.scenario.agents.controller, setup.owned[agent - 1]
        self._peers = tuple(other for other in setup.agents if other != agent)
        self._controller: Any = None
        self.restart()
        if self._problem:
            raise ScenarioError(setup.scenario.name, "agents.controller", self._problem)

    def restart(self) -> None:
        """Start a new object of the class, without knowledge of the run so far."""
        self.stop()
        setup, uavs = self._setup, len(self._owned)
        self._run = Run(
            agent=self._agent,
            owned=self._owned,
            system=setup.system,
            model=setup.model,
            x_hover=setup.hover.x.copy(),
            u_hover=setup.hover.u.copy(),
            lower=setup.settings.lower(uavs),
            upper=setup.settings.upper(uavs),
            period_s=setup.settings.sampling_period_s,
            ticks=setup.ticks,
            horizon=setup.settings.horizon,
            delay=int(setup.scenario.clock.next_tick),
            seed=setup.scenario.seed,
            _X_ref=setup.X_ref,
        )
        self._measurement: Measurement | None = None  # the newest that is usable
        self._newest: dict[int, int] = {}  # tick of the newest plan used, by agent
        self._previous = 0, setup.hover.u[input_indices(self._owned)][None]  # first tick and rows of the last plan
        self._problem = ""  # why the class did not start
        self._idle_since_ns = self._stopwatch()
        try:
            controller = made(own_class(self._name), ("start", "step", "stop"))
            with told("start"):
                controller.start(self._run)
            self._controller = controller
        except OwnClassError as error:
            self._problem = str(error)

    def head(self, setup: Setup) -> None:
        """Let the class have the reference with a further target, from that target's tick on."""
        self._setup, self._run._X_ref = setup, setup.X_ref

    def stop(self) -> str:
        """End the run for the class, once; return why that failed, empty if it did not."""
        controller, self._controller = self._controller, None
        try:
            with told("stop"):
                if controller is not None:
                    controller.stop()
        except OwnClassError as error:
            return str(error)
        return ""

    def warm_up(self) -> None:
        """Do nothing: the class prepares itself when it starts."""

    def begin(self, known: Known) -> OwnStep:
        """Take in what has arrived at a tick."""
        if known.measurements:
            self._measurement = max(known.measurements, key=lambda measurement: measurement.tick)
        for plan in known.plans:
            self._newest[plan.agent] = max(plan.tick, self._newest.get(plan.agent, -1))
        self._run.tick = known.measurement.tick
        self._run.agents, self._run.failed = tuple(sorted(known.agents)), tuple(sorted(known.off))
        return OwnStep(known)

    def plan(self, step: OwnStep, out: Outbox, publish_ns: int) -> list[Message]:
        """Return the tick's plan and report, and a note if the class has something to say or has failed."""
        known, step.negotiation, begun_ns = step.known, 0, self._stopwatch()
        k, start = known.measurement.tick, known.measurement.tick + self._run.delay
        inputs = self._previous[1][min(start - self._previous[0], len(self._previous[1]) - 1) :]
        status: PlanStatus = "solved"
        data: Mapping[str, float] = {}
        problem = ""
        try:
            inputs, data = self._stepped(known, inputs)
        except OwnClassError as error:
            status, problem = "numerical", str(error)
        self._previous = start, inputs
        measured = self._measurement
        states = StateView(self._run.reference(k)).uavs[list(self._owned)] if measured is None else measured.uav_states
        plan = out.stamp(
            Plan,
            tick=k,
            agent=self._agent,
            start_tick=start,
            uavs=tuple(uav + 1 for uav in self._owned),
            uav_states=states,
            inputs=inputs,
            corrections=np.zeros((0, inputs.shape[1])),
            status=status,
            negotiation=0,
            shared=True,
        )
        now_ns = self._stopwatch()
        waited_ns = known.started_ns - self._idle_since_ns
        spent_ns = {"wait": waited_ns, "publish": publish_ns, "solve": now_ns - begun_ns}
        ages = tuple(k - self._newest[peer] if peer in self._newest else -1 for peer in self._peers)
        report = step_report(
            known,
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
            times_ns={**dict.fromkeys(STAGES, 0), **spent_ns, "total": now_ns - known.started_ns},
        )
        note = self._note(k, problem, data, out)
        self._idle_since_ns = self._stopwatch()
        return [*note, plan, report]

    def end(self, tick: int, out: Outbox) -> list[Message]:
        """End the run for the class; return a note if that failed."""
        return self._note(tick, self.stop(), {}, out)

    def _note(self, tick: int, problem: str, data: Mapping[str, float], out: Outbox) -> list[Message]:
        if not problem and not data:
            return []
        said = f"controller {self._name}: {problem}" if problem else ""
        names, values = tuple(data), list(data.values())
        return [out.stamp(Note, tick=tick, agent=self._agent, problem=said, names=names, values=values)]

    def _stepped(self, known: Known, previous: Array) -> tuple[Array, Mapping[str, float]]:
        """Return inputs of a step, (rows, 4 owned), within the limits, and numbers. Raises: OwnClassError: it fails."""
        if self._controller is None:
            raise OwnClassError(self._problem)
        if self._measurement is None:
            return previous, {}
        data: object = {}
        with told("step"):
            given = self._controller.step(self._measurement, known.plans)
            if isinstance(given, tuple) and len(given) == 2 and isinstance(given[1], Mapping):
                given, data = given
            inputs, columns, rows = np.atleast_2d(real_array(given)), len(self._run.lower), self._run.horizon
            numbers = {str(name): float(value) for name, value in dict(data).items()}  # type: ignore[call-overload]
        if inputs.ndim != 2 or inputs.shape[1] != columns or not 1 <= len(inputs) <= rows:
            expected = f"expected shape ({columns},) or (1 to {rows}, {columns})"
            raise OwnClassError(f"step: {expected}, got {np.shape(given)}")
        given_numbers = {**{f"input {list(at)}": value for at, value in np.ndenumerate(inputs)}, **numbers}
        if wrong := [f"{name} = {value}" for name, value in given_numbers.items() if not math.isfinite(value)]:
            raise OwnClassError(f"step: expected finite inputs and numbers for the log, got {wrong[0]}")
        if len(numbers) > MAX_NAMES or any(len(name) > MAX_NAME for name in numbers):
            expected = f"expected at most {MAX_NAMES} numbers with names of at most {MAX_NAME} characters"
            raise OwnClassError(f"step: {expected} for the log, got {len(numbers)}")
        return np.clip(inputs, self._run.lower, self._run.upper), numbers
