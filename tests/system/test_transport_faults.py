"""Faults across real processes.

Scripted faults occur at their ticks, runs survive them, and the record names them.
"""

import json
import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.support.commands import SHORT, Forked, processes_of, settings
from tests.support.troubles import FAULTS, HEAVY, ITERATIONS, NEXT_TICK
from transport.flight.memory import simulate
from transport.log.run_log import RunLog, read_log
from transport.log.writer import LogWriter
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Control, FaultNote, Message, Plan, Roster, Tick
from transport.report.report import write_report

LOST = 4


def messages(log: RunLog) -> list[Message]:
    """Return the recorded messages, in order."""
    return [entry.message for entry in log.messages]


def steps(folder: Path) -> list[list[str]]:
    """Return the step table without its wall-clock columns."""
    rows = [line.split(",") for line in (folder / "steps.csv").read_text().splitlines()]
    kept = [i for i, name in enumerate(rows[0]) if not name.endswith("_ms")]
    return [[row[i] for i in kept] for row in rows]


@pytest.fixture(scope="module")
def troubled(forked: Callable[..., Forked], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run with all faults at once.

    Impaired links, two iterations, a kill and a freeze.
    """
    folder = tmp_path_factory.mktemp("troubled")
    changes = settings(SHORT, HEAVY, ITERATIONS, NEXT_TICK, *FAULTS)
    options = ["--out", "run", "--no-figures"]
    code, printed = forked("run", "resilient", *changes, *options, cwd=folder).end()
    assert code == 0, printed
    assert processes_of("run") == {}
    return folder / "run"


def test_a_troubled_run_equals_the_one_in_memory(troubled: Path, tmp_path: Path) -> None:
    """With all faults at once the step table equals that of the in-memory run, bit for bit, except wall-clock times."""
    scenario = tmp_path / "scenario.toml"
    shutil.copy(troubled / "scenario.toml", scenario)
    run = Setup.of(read_scenario(scenario), str(scenario))
    header = read_log(troubled / "run.mcap").header
    with closing(LogWriter(tmp_path / "run.mcap", header, period_ns=run.period_ns)) as writer:
        control = simulate(run, lambda message: writer.write(message, 0))
    assert control.outcome == "completed"
    write_report(tmp_path, figures=False)
    assert steps(troubled) == steps(tmp_path)
    assert len(steps(troubled)) == 1 + 4 * 30 - 8 - 8


def test_faults_are_in_the_summary(troubled: Path) -> None:
    """The summary has fault, detection and return of each agent, with scenario time and wall-clock time."""
    summary = json.loads((troubled / "summary.json").read_text())
    assert (summary["outcome"], summary["exit_code"], summary["log_cut"]) == ("completed", 0, None)

    def events(name: str) -> list[dict[str, Any]]:
        return [event for event in summary["faults"] if event["processes"] == [name]]

    frozen, killed = events("agent2"), events("agent4")
    # The parent polls for scripted faults, on a busy machine after the others have detected them.
    assert {(event["kind"], event["what"]) for event in frozen} == {
        ("fault", "agent2 stopped by script"),
        ("detected", "agent2 did not answer tick 6 in time at t = 0.30 s"),
        ("fault", "agent2 continued by script"),
        ("rejoined", "agent2 joined at t = 0.70 s"),
    }
    assert [event["what"] for event in killed if event["kind"] == "fault"] == [
        "agent4 killed by script",
        "agent4 restarted by script",
    ]
    assert [event["what"] for event in killed if event["kind"] == "detected"] == [
        "agent4 is gone at t = 0.50 s"
    ]
    assert [event["what"] for event in killed if event["kind"] == "rejoined"] == [
        "agent4 joined at t = 0.90 s"
    ]
    for found, ticks in ((frozen, (6, 14)), (killed, (10, 18))):
        assert next(event["tick"] for event in found if event["kind"] == "fault") == ticks[0]
        assert [
            event["tick"] for event in found if event["kind"] in ("detected", "rejoined")
        ] == list(ticks)
        times = [event["wall_s"] for event in found if event["kind"] in ("detected", "rejoined")]
        assert times == sorted(times)


def test_a_return_is_a_new_start(troubled: Path) -> None:
    """A restarted agent has a higher incarnation, which rosters name from then on.

    The old one is ignored.
    """
    found = messages(read_log(troubled / "run.mcap"))
    rosters = [message for message in found if isinstance(message, Roster)]
    assert [roster.agents for roster in rosters] == [
        (1, 2, 3, 4),
        (1, 3, 4),
        (1, 3),
        (1, 2, 3),
        (1, 2, 3, 4),
    ]
    assert rosters[-1].incarnations == (0, 1, 0, 1)
    for agent, (left, back) in {2: (6, 14), 4: (10, 18)}.items():
        plans = {
            (plan.incarnation, plan.tick)
            for plan in found
            if isinstance(plan, Plan) and plan.agent == agent
        }
        assert {tick for incarnation, tick in plans if incarnation == 1} == set(range(back, 30))
        # A continued process may still send the plan of the tick at which it was stopped; this plan
        # is no answer.
        assert {tick for incarnation, tick in plans if incarnation == 0} - {left} == set(
            range(left)
        )
    answered = {tick.tick: tick.answered for tick in found if isinstance(tick, Tick)}
    assert [k for k in range(1, 30) if 2 not in answered[k]] == list(range(7, 15))
    assert [k for k in range(1, 30) if 4 not in answered[k]] == list(range(11, 19))
    notes = [(note.target, note.what, note.origin) for note in found if isinstance(note, FaultNote)]
    assert ("agent4", "restarted", "script") in notes


def aborted(
    forked: Callable[..., Forked], folder: Path, victim: str, do: str, *changes: str
) -> dict[str, Any]:
    """Return the summary of a run that a fault at t = 0.5 s ends; no process is left."""
    event = f"faults.event=[{{at_s=0.5,do='{do}',target='{victim}'}}]"
    words = [*settings(SHORT, event, *changes), "--out", victim, "--no-figures"]
    code, printed = forked("run", "resilient", *words, cwd=folder).end()
    assert code == LOST, printed
    assert "Traceback" not in printed
    assert processes_of(victim) == {}
    summary: dict[str, Any] = json.loads((folder / victim / "summary.json").read_text())
    assert (summary["outcome"], summary["exit_code"]) == ("aborted", LOST)
    return summary


def test_a_run_needs_its_plant(forked: Callable[..., Forked], tmp_path: Path) -> None:
    """A run whose plant is killed by script at a tick ends there, regardless of `on_agent_loss`."""
    summary = aborted(forked, tmp_path, "plant", "kill", "clock.on_agent_loss=continue")
    assert summary["reason"] == "plant is gone"
    assert summary["log_cut"] is None
    (noted,) = (event for event in summary["faults"] if event["kind"] == "fault")
    assert (noted["what"], noted["tick"]) == ("plant killed by script", 10)
    assert "end" in {event["kind"] for event in summary["faults"]}
    # It is killed on the message that opens tick 10, and may not have sent its last messages.
    assert summary["ticks"] in (9, 10)
    found = messages(read_log(tmp_path / "plant" / "run.mcap"))
    assert sum(isinstance(message, Control) for message in found) == 1


@pytest.mark.slow
def test_a_frozen_coordinator(forked: Callable[..., Forked], tmp_path: Path) -> None:
    """The network gives up a coordinator that is stopped for good at the end of its lease of 10 s."""
    summary = aborted(forked, tmp_path, "coordinator", "stop")
    assert summary["reason"] == "coordinator is gone"
    # The last relay may still be in the stopped process: without it the plant does not integrate
    # the period of tick 9. The plant may have it and the recorder not: the summary names the gap.
    assert summary["ticks"] in (9, 10)
    assert summary["log_cut"] in (None, "some messages of ticks 9 to 9 did not reach the recorder")


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_coordinator_that_wakes_up(
    mode: str, forked: Callable[..., Forked], tmp_path: Path
) -> None:
    """A coordinator frozen for longer than the barrier timeout drops no agent for its own absence: the run goes on."""
    hover = "maneuver.phase=[{name='hover',duration_s=3.5,displacement_m=[0,0,0]}]"
    pace = (f"clock.mode={mode}", "clock.speed=1.0", "clock.barrier_timeout_s=2.0")
    event = "faults.event=[{at_s=0.3,do='stop',target='coordinator'},{at_s=3.0,do='continue',target='coordinator'}]"
    words = [*settings(hover, *pace, event), "--out", "run", "--no-figures"]
    code, printed = forked("run", "resilient", *words, cwd=tmp_path).end()
    assert code == 0, printed
    log = read_log(tmp_path / "run" / "run.mcap")
    assert [roster.reason for roster in log.of(Roster)] == ["all processes are ready"]
    opened_s = {tick: at / 1e9 for tick, at in log.received_ns(Tick).items()}
    assert max(opened_s[k + 1] - opened_s[k] for k in range(69)) > 2.0  # the coordinator was away
    assert processes_of("run") == {}
