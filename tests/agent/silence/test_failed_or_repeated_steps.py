"""Controllers that are dead while their processes go on sending: the team flies as without them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import transport
from tests.support import runs
from tests.support.runs import setup
from transport.agent.planning.mpc_planner import MpcStep, Planner
from transport.agent.received import Received
from transport.agent.silence.failed_or_repeated_steps import Freshness, Repetition
from transport.agent.user_class.run_for_user import Run
from transport.mpc.controller import Controller
from transport.mpc.program.quadratic_program import QP, Solution, unsolved
from transport.protocol.scenario.user_class.user_import import own_class
from transport.protocol.wire.messages import Measurement, Plan, PlantState

EXAMPLES = Path(__file__).resolve().parents[3] / "docs" / "examples"
# The agent that is dead, and since when, in the climb; it is killed in the flight to compare with.
DEAD, DEAD_S, FROM = 3, 5.4, 108
KILLED = [{"at_s": DEAD_S, "do": "kill", "target": f"agent{DEAD}"}]
PHASES = [
    {"name": "hover", "duration_s": 5.0, "displacement_m": [0.0, 0.0, 0.0]},
    {"name": "climb", "duration_s": 5.0, "displacement_m": [0.0, 0.0, -2.5]},
]
PLAYED = 8  # ticks that actuators play at most: 0.4 s
# Largest difference from the flight without the agent.
APART_DEG, APART_M = 1.0, 0.02


def is_dead(agent: int, tick: int) -> bool:
    """Return whether the controller of an agent is dead at a tick."""
    return agent == DEAD and tick >= FROM


class Raises:
    """The PID of docs/own-algorithm.md, until its every step raises."""

    def start(self, run: Run) -> None:
        """Start the PID."""
        self.run = run
        self.pid: Any = own_class("pid:PID")()
        self.pid.start(run)

    def step(self, measured: Measurement, messages: Sequence[Plan]) -> object:
        """Return the inputs of the PID, or raise."""
        if is_dead(self.run.agent, self.run.tick):
            raise RuntimeError("unexpected data")
        return self.pid.step(measured, messages)

    def stop(self) -> None:
        """Nothing is open."""


class Frozen(Raises):
    """The same, which returns its last inputs for ever instead."""

    def step(self, measured: Measurement, messages: Sequence[Plan]) -> object:
        """Return the inputs of the PID, or the last ones."""
        if not is_dead(self.run.agent, self.run.tick):
            self.last = super().step(measured, messages)
        return self.last


def flown(scenario: str, **settings: Any) -> transport.Run:
    """Return a flight whose team goes on without agents that are lost."""
    return transport.fly(
        scenario, phases=PHASES, on_agent_loss="continue", progress=False, **settings
    )


def test_a_dead_class_is_as_if_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that raises for ever, and one that returns the same for ever: told, and a failed run.

    Without the age of their plans both turn the payload by 85 deg.
    """
    monkeypatch.chdir(EXAMPLES)
    killed = flown("resilient", controller="pid:PID", faults=KILLED).summary
    for dead, told in ((Raises, "unexpected data"), (Frozen, "suspicious")):
        summary = flown("resilient", controller=dead).summary
        assert summary["attitude_max_deg"] <= killed["attitude_max_deg"] + APART_DEG
        assert summary["separation_min_m"] >= killed["separation_min_m"] - APART_M
        assert summary["exit_code"] == 7
        notices = [fault for fault in summary["faults"] if told in fault["what"]]
        assert [fault["processes"] for fault in notices] == [[f"agent{DEAD}"]]


def test_an_agent_that_never_solves_is_as_if_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The project's own fallback does not keep a dead solver in control.

    Inputs of open-loop plans that nothing corrects would turn the payload by 28 deg.
    """
    killed = flown("paper", settings={"controller.fail_safe": "follow"}, faults=KILLED).summary
    of_this_step = [False]
    begin = Planner.begin
    solve = Controller.solve

    def begin_noted(self: Planner, received: Received) -> MpcStep:
        of_this_step[0] = is_dead(self._agent, received.tick)
        return begin(self, received)

    def solve_or_not(self: Controller, qp: QP) -> Solution:
        return unsolved(0, 0, "daqp") if of_this_step[0] else solve(self, qp)

    monkeypatch.setattr(Planner, "begin", begin_noted)
    monkeypatch.setattr(Controller, "solve", solve_or_not)
    run = flown("paper", settings={"controller.fail_safe": "follow"})
    summary = run.summary
    assert summary["attitude_max_deg"] <= killed["attitude_max_deg"] + APART_DEG
    assert summary["separation_min_m"] >= killed["separation_min_m"] - APART_M
    # Its last fresh inputs are played for 0.4 s, then its UAV is on the fail-safe.
    sources = {state.tick: state.plan_ticks[DEAD - 1] for state in run.log.of(PlantState)}
    last = FROM - 1 + PLAYED
    assert [sources[tick] for tick in (last - 1, last, last + 50)] == [last - 1, -2, -2]
    # To the others its plans are as old as the last solved step.
    assert summary["plan_age_ticks"]["max"] == len(sources) - FROM


def test_age_since_the_last_solved_step() -> None:
    """It grows by each step that fails, and is 0 again with the next one that does not."""
    freshness = Freshness()
    ages = []
    for tick, is_solved in enumerate([False, False, True, False, False, True], start=7):
        ages.append(freshness.age(tick, is_solved=is_solved))
        freshness.conclude(tick, is_solved=is_solved)
    # Before the first solution it counts from the first step.
    assert ages == [0, 1, 0, 1, 2, 0]


RUN = setup()
HOVER = RUN.hover.u[None, :4]


def ages(inputs: Sequence[Any], drift: float) -> list[int]:
    """Return since when inputs are suspicious, tick by tick, while the measurement drifts."""
    repetition = Repetition(RUN.settings.sampling_period_s)
    found = []
    for tick, asked in enumerate(inputs):
        x = RUN.initial_state()
        x[0] += drift * tick
        measured = runs.measurement(RUN, 1, tick, x=x)
        found.append(repetition.age(tick, np.atleast_2d(asked), measured))
    return found


def test_the_same_inputs_for_long() -> None:
    """They are suspicious once they last longer than the actuators play a plan, from the first on."""
    steps = [HOVER, *[HOVER + 0.1] * 12, HOVER]
    expected = [max(tick - 1, 0) if tick > 1 + PLAYED else 0 for tick in range(13)]
    assert ages(steps, drift=1e-3) == [*expected, 0]


def test_the_same_inputs_at_rest() -> None:
    """They are right while what is measured is the same, but for rounding."""
    assert ages([HOVER] * 40, drift=0.0) == [0] * 40
    assert ages([HOVER] * 40, drift=1e-12) == [0] * 40


def test_inputs_that_move() -> None:
    """A feedback in its last digits is at work, as is one that commands beyond the limits."""
    assert ages([HOVER * (1.0 + 1e-15 * k) for k in range(40)], drift=1e-3) == [0] * 40


class Beyond:
    """A class that commands more thrust than there is, and more at each tick."""

    def start(self, run: Run) -> None:
        """Keep the run."""
        self.run = run

    def step(self, measured: Measurement, messages: Sequence[Plan]) -> object:
        """Return inputs beyond their limits."""
        return self.run.upper * (2.0 + self.run.tick)

    def stop(self) -> None:
        """Nothing is open."""


def test_a_class_at_its_limits_is_not_suspicious() -> None:
    """Its UAVs apply the same for ever, but the class moves."""
    rest = [{"name": "hover", "duration_s": 1.0, "displacement_m": [0.0, 0.0, 0.0]}]
    wide = {"plant.max_error_m": 1000.0}
    run = transport.fly("resilient", wide, controller=Beyond, phases=rest, progress=False)
    assert {plan.stale for plan in run.log.of(Plan)} == {0}
    assert run.summary["solver"]["failures"] == 0
