"""A controller of the user among real processes.

The same bits as in memory, and its failures in the report.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import transport
from tests.support.commands import SHORT, Forked, settings
from tests.support.own_classes import Chain
from transport.protocol.wire.errors_and_exit_codes import (
    EXIT_FAILED,
    EXIT_SCENARIO,
    EXIT_UNREACHABLE,
)
from transport.protocol.wire.messages import Note, Plan, PlantState

# Plans of an agent that takes four periods a step, of 25 ticks: most are late on any machine.
MISSED_PLANS = 5

FAILS = """
class Fails:
    version = "7"
    def start(self, run):
        print("to standard error")
        self.run = run
    def step(self, measurement, messages):
        if self.run.tick == 4 and self.run.agent == 3:
            raise OSError("no solver")
        return self.run.u_hover[4 * self.run.owned[0] :][:4], {"tick": self.run.tick}
    def stop(self):
        raise OSError("cannot stop")
"""


def flown(
    forked: Callable[..., Forked], folder: Path, *options: str, out: str = "out"
) -> tuple[int, str]:
    """Fly the paper's run with processes from a folder; return exit code and output."""
    return forked("run", "paper", *options, "--out", out, "--no-figures", cwd=folder).end()


def summary_of(folder: Path) -> dict[str, Any]:
    """Return the summary in a run's folder."""
    found: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("iterations", [1, 3])
def test_data_of_processes_have_the_same_bits(tmp_path: Path, iterations: int) -> None:
    """Own data, numbers for the log and exchanges are those in memory, with an impaired network and, of one, a death.

    The class keeps a chain over all that it hears, so that every loss, order and bit shows.
    """
    faults = [
        {"at_s": 0.5, "do": "kill", "target": "agent2"},
        {"at_s": 1.0, "do": "restart", "target": "agent2"},
    ]
    scenario = transport.Scenario(
        "resilient",
        {"controller.negotiation_iterations": iterations, "links.duplicate": 0.2},
    )
    given: dict[str, Any] = {
        "controller": Chain,
        "delay_s": 0.06,
        "loss": 0.2,
        "phases": [{"name": "climb", "duration_s": 2.0, "displacement_m": [0.0, 0.0, -0.5]}],
        "faults": faults if iterations == 1 else [],
        "on_agent_loss": "continue",
    }
    runs = [
        transport.fly(scenario, processes=processes, folder=folder, progress=False, **given)
        for processes, folder in ((False, None), (True, tmp_path / "run"))
    ]
    data = [
        {(one.agent, one.tick, one.negotiation): one.data.tobytes() for one in run.log.of(Plan)}
        for run in runs
    ]
    assert len(data[0]) >= 4 * 40 * iterations - 10
    assert data[0] == data[1]
    paths = [np.array([state.x for state in run.log.of(PlantState)]) for run in runs]
    assert len(paths[0]) == 40
    assert paths[0].tobytes() == paths[1].tobytes()
    notes = [
        {(note.agent, note.tick): note.values.tolist() for note in run.log.of(Note)} for run in runs
    ]
    assert len(notes[0]) == 4 * 40 - (10 if iterations == 1 else 0)
    assert notes[0] == notes[1]
    assert {run.summary["controller"]["name"] for run in runs} == {f"{Chain.__module__}:Chain 1"}


@pytest.mark.slow
def test_a_failing_class_among_processes(forked: Callable[..., Forked], tmp_path: Path) -> None:
    """The run completes; summary and log name class, error, file and line.

    A class that is none is refused at once.
    """
    (tmp_path / "mine.py").write_text(FAILS, encoding="utf-8")
    options = settings(SHORT, "agents.controller=mine:Fails")
    code, printed = flown(forked, tmp_path, *options)
    assert code == 0, printed
    summary = summary_of(tmp_path / "out")
    assert summary["solver"]["failures"] == 1
    what = "controller mine:Fails: {} raised OSError: {} (mine.py:{})"
    events = [event["what"] for event in summary["faults"]]
    assert f"agent3: {what.format('step', 'no solver', 9)}" in events
    assert sum(what.format("stop", "cannot stop", 12) in text for text in events) == 1
    refused = forked("validate", "paper", *settings("agents.controller=mine:Other"), cwd=tmp_path)
    code, printed = refused.end()
    assert code == EXIT_SCENARIO
    where = f"its import from {tmp_path} or the installed packages"
    expected = f"{where} raised AttributeError: module 'mine' has no attribute 'Other'"
    assert printed == f"transport: --set agents.controller=mine:Other: {expected}\n"


ALWAYS = """
class Always:
    def start(self, run):
        self.run = run
    def step(self, measurement, messages):
        if self.run.agent in {agents}:
            raise OSError("no solver")
        return self.run.u_hover[4 * self.run.owned[0] :][:4]
    def stop(self):
        pass
"""


@pytest.mark.slow
def test_a_controller_that_never_works_is_no_success(
    forked: Callable[..., Forked], tmp_path: Path
) -> None:
    """Exit code 7; first line, limits and events name all agents that failed."""
    agents = (2, 3)
    (tmp_path / "mine.py").write_text(ALWAYS.replace("{agents}", str(agents)), encoding="utf-8")
    options = settings(SHORT, "agents.controller=mine:Always")
    code, printed = flown(forked, tmp_path, *options)
    assert code == EXIT_FAILED, printed

    lines = printed.splitlines()
    (first,) = (line for line in lines if line.startswith("paper failed"))
    names = ", ".join(f"agent{agent}" for agent in agents)
    assert first.startswith(f"paper failed: {names} failed in 30 of 30 steps")
    (error,) = (line for line in lines if line.startswith("transport: "))
    assert error.startswith(f"transport: {names} failed in 30 of 30 steps")
    (limits,) = (line for line in lines if line.split()[:1] == ["limits"])
    assert "held" not in limits
    assert f"{30 * len(agents)} steps without a controller" in limits

    summary = summary_of(tmp_path / "out")
    assert (summary["outcome"], summary["exit_code"]) == ("failed", EXIT_FAILED)
    assert [one["agent"] for one in summary["solver"]["failed_agents"]] == list(agents)
    (notice,) = (event for event in summary["faults"] if event["kind"] == "notice")
    assert notice["processes"] == [f"agent{agent}" for agent in agents]
    assert notice["what"].startswith(f"{names}: controller mine:Always: step raised OSError")


SLOW = """
import time
class Slow:
    version = "1"
    def start(self, run):
        self.run = run
    def step(self, measurement, messages):
        if self.run.agent == 3 and self.run.tick >= 5:
            time.sleep({sleep_s})
        return self.run.u_hover[4 * self.run.owned[0] :][:4]
    def stop(self):
        pass
"""


@pytest.mark.slow
def test_a_class_that_is_too_slow(forked: Callable[..., Forked], tmp_path: Path) -> None:
    """In lockstep the team waits as long as the barrier: exit code 4, with the agent in one line.

    In real time its plans miss their deadlines, which the summary counts.
    """
    (tmp_path / "mine.py").write_text(SLOW.replace("{sleep_s}", "6.0"), encoding="utf-8")
    options = settings(SHORT, "agents.controller=mine:Slow", "clock.barrier_timeout_s=2.0")
    code, printed = flown(forked, tmp_path, *options)
    assert code == EXIT_UNREACHABLE
    why = "agent3 did not answer tick 5 in time at t = 0.25 s"
    lines = printed.splitlines()
    errors = [line for line in lines if line.startswith("transport: ")]
    assert errors[-1] == f"transport: {why}; logs in out/logs"  # after processes that were killed
    assert any(line.startswith(f"paper aborted: {why}") for line in lines)

    (tmp_path / "late.py").write_text(SLOW.replace("{sleep_s}", "0.2"), encoding="utf-8")
    realtime = ("clock.mode=realtime", "clock.actuation=next_tick", "clock.speed=1.0")
    options = settings(SHORT, "agents.controller=late:Slow", *realtime)
    flown(forked, tmp_path, *options, out="late")
    summary = summary_of(tmp_path / "late")
    assert summary["outcome"] == "completed"
    assert summary["deadline"]["missed"] >= MISSED_PLANS
    assert summary["solver"]["failures"] == 0
