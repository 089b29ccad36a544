"""Requests to an active run: status, links, faults; impossible requests are refused with a text."""

import json
import signal
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.support.commands import PATIENCE_S, is_flying, processes_of, settings, start, wait_for
from transport.cli.main import app
from transport.log.run_log import RunLog, read_log
from transport.protocol.wire.messages import FaultNote, LinkChange, Roster, StepReport, Tick

TEAM = ["coordinator", "plant", "agent1", "agent2", "agent3", "agent4"]
PACED = ("clock.speed=1.0", "clock.on_agent_loss=continue")
BUSY_S = 2.0  # a step on a busy machine; less than half of the timeout
USAGE, INTERRUPTED = 2, 130


def invoke(*arguments: str) -> tuple[int, str, str]:
    """Return exit code, output and error text of a command."""
    result = CliRunner().invoke(app, list(arguments))
    return result.exit_code, result.stdout.strip(), result.stderr.strip()


def succeed(*arguments: str) -> str:
    """Return the output of a command that must succeed."""
    code, output, errors = invoke(*arguments)
    assert code == 0, errors
    return output


def members() -> list[int]:
    """Return the agents on the roster of the most recent run in runs/."""
    found: list[int] = json.loads(succeed("status", "--format", "json"))["members"]
    return found


@pytest.fixture(scope="module")
def operated(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[dict[str, Any], Path, list[tuple[int, str, str]]]]:
    """Return summary, folder and refusals of a paced run that received every kind of request and then ended."""
    home = tmp_path_factory.mktemp("operated")
    process = start(
        "run", "resilient", *settings(*PACED), "--out", "runs/live", "--no-figures", cwd=home
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        try:
            assert wait_for(is_flying(home / "runs" / "live", TEAM)), process.communicate(
                timeout=10
            )
            assert wait_for(
                lambda: (
                    invoke("status")[0] == 0
                    and json.loads(succeed("status", "--format", "json"))["tick"] > 5
                )
            )
            refusals = [
                invoke("fault", "kill", "agent9"),
                invoke("fault", "stab", "agent1"),
                invoke("fault", "restart", "plant"),
                invoke("fault", "continue", "recorder"),
                invoke("link", "set", "--from", "9", "--loss", "0.1"),
                invoke("link", "set", "--distribution", "gauss"),
                invoke("link", "set"),
                invoke("link", "set", "--between", "1,2/9", "--loss", "1"),
                invoke("status", "--run", "nowhere"),
            ]
            succeed("link", "set", "--from", "1", "--to", "2", "--delay", "0.2")
            succeed(
                "link",
                "set",
                "--from",
                "plant",
                "--to",
                "agent1",
                "--delay",
                "0.1",
                "--run",
                "live",
            )
            succeed("fault", "kill", "agent3")
            assert wait_for(lambda: members() == [1, 2, 4])
            refusals.append(invoke("fault", "stop", "agent3"))
            succeed("fault", "restart", "agent3", "--run", "runs/live")
            assert wait_for(lambda: members() == [1, 2, 3, 4])
            succeed("fault", "stop", "agent4")
            assert wait_for(lambda: members() == [1, 2, 3])
            succeed("fault", "continue", "agent4")
            assert wait_for(lambda: members() == [1, 2, 3, 4])
            succeed("link", "clear")
            succeed("link", "set", "--between", "1/2,3", "--loss", "0")
            tick = json.loads(succeed("status", "--format", "json"))["tick"]
            assert wait_for(
                lambda: json.loads(succeed("status", "--format", "json"))["tick"] > tick + 10
            )
        finally:
            process.send_signal(signal.SIGINT)
            output, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == INTERRUPTED, errors
        assert "Traceback" not in output + errors
        refusals.append(invoke("status"))
    summary = json.loads((home / "runs" / "live" / "summary.json").read_text())
    yield summary, home / "runs" / "live", refusals
    assert processes_of("live") == {}


@pytest.fixture(scope="module")
def log(operated: tuple[dict[str, Any], Path, list[tuple[int, str, str]]]) -> RunLog:
    """Return the log of that run."""
    found = read_log(operated[1] / "run.mcap")
    assert not found.cut
    return found


def test_impossible_requests_are_refused(
    operated: tuple[dict[str, Any], Path, list[tuple[int, str, str]]],
) -> None:
    """A process, action, link or run that does not exist is refused in one line with expected and got, exit code 2."""
    expected = [
        "target: expected one of coordinator, plant, agent1, agent2, agent3, agent4, got 'agent9'",
        "'ACTION': 'stab' is not one of 'kill', 'stop', 'continue', 'restart'",
        "target: expected an agent to restart, as a run ends with its plant",
        "target: expected one of coordinator, plant, agent1, agent2, agent3, agent4, got 'recorder'",
        "from: expected one of plant, agent1, agent2, agent3, agent4, got 'agent9'",
        "distribution: expected 'uniform'",
        "expected at least one of --delay, --jitter, --loss, ..., got none",
        "groups: expected two or more lists of agents, each once, got [['agent1', 'agent2'], ['agent9']]",
        "no active run in nowhere; name its folder with --run",
        "agent3 is not running",
        "no active run in runs/",
    ]
    for (code, output, errors), text in zip(operated[2], expected, strict=True):
        assert (code, output) == (USAGE, "")
        assert errors.startswith("transport: ")
        assert text in errors
        assert len(errors.splitlines()) == 1


def test_links_by_hand(log: RunLog) -> None:
    """Changes are in the log and apply to the named links from their tick on until they are cleared."""
    changes = list(log.of(LinkChange))
    first = {change.number: change for change in changes}
    assert list(first) == list(range(1, 10))
    cleared_at, cut_at = {first[i].tick for i in (3, 4, 5)}, {first[i].tick for i in (6, 7, 8, 9)}
    assert (len(cleared_at), len(cut_at)) == (1, 1)
    assert (first[1].source, first[1].target, json.loads(first[1].settings)) == (
        "agent1",
        "agent2",
        {"delay_s": 0.2},
    )
    delayed, seen, cleared, seen_again = (first[number].tick for number in (1, 2, 3, 4))
    ages = {
        (r.agent, r.tick): dict(zip(r.peers, r.plan_ages, strict=True)) for r in log.of(StepReport)
    }
    flown = range(delayed + 4, cleared)
    assert {ages[2, k][1] for k in flown} == {4}
    assert {ages[2, k][1] for k in range(delayed)} | {ages[1, k][2] for k in flown} <= {-1, 1}
    assert {ages[2, k][1] for k in range(cleared + 1, cleared + 5)} == {1}
    measured = {
        report.tick: report.measurement_age for report in log.of(StepReport) if report.agent == 1
    }
    assert {measured[k] for k in range(seen + 2, seen_again)} == {2}
    assert {measured[k] for k in range(seen_again, seen_again + 5)} == {0}
    # The returning agent received the two active changes.
    assert [change.number for change in changes if change not in first.values()] == [1, 2] * 2


def test_faults_by_hand(
    operated: tuple[dict[str, Any], Path, list[tuple[int, str, str]]], log: RunLog
) -> None:
    """Each fault is noted as requested, detected and repaired, in this order.

    Both agents take part to the end.
    """
    notes = [(note.target, note.what) for note in log.of(FaultNote) if note.origin == "person"]
    assert notes == [
        ("agent3", "killed"),
        ("agent3", "restarted"),
        ("agent4", "stopped"),
        ("agent4", "continued"),
    ]
    for name, words in (
        ("agent3", ["is gone", "joined"]),
        ("agent4", ["did not answer", "joined"]),
    ):
        events = [
            event
            for event in operated[0]["faults"]
            if event["processes"] == [name] and event["kind"] != "fault"
        ]
        assert [event["kind"] for event in events] == ["detected", "rejoined"]
        assert all(word in event["what"] for word, event in zip(words, events, strict=True))
    *_, last = log.of(Roster)
    assert (last.agents, last.incarnations) == ((1, 2, 3, 4), (0, 0, 1, 1))
    end = max(report.tick for report in log.of(StepReport))
    assert {report.agent for report in log.of(StepReport) if report.tick == end - 1} == {1, 2, 3, 4}


def test_a_killed_agent_delays_no_other(log: RunLog) -> None:
    """The tick at which an agent is killed ends with its detection, not with the timeout of the clock (5 s)."""
    opened_s = {tick: at / 1e9 for tick, at in log.received_ns(Tick).items()}
    durations_s = {k: opened_s[k + 1] - opened_s[k] for k in opened_s if k + 1 in opened_s}
    noted_s = {}
    for entry in log.messages:
        if isinstance(entry.message, FaultNote) and entry.message.what == "killed":
            noted_s["fault"] = entry.received_ns / 1e9
        elif isinstance(entry.message, Roster) and entry.message.reason.startswith(
            "agent3 is gone"
        ):
            noted_s["detected"], tick = entry.received_ns / 1e9, entry.message.tick
    detection_s = noted_s["detected"] - noted_s["fault"]
    assert durations_s[tick] <= max(detection_s, 0.0) + BUSY_S


def test_ticks_come_one_after_the_other(log: RunLog) -> None:
    """No tick is omitted or opened twice, despite all faults."""
    assert all(after.tick == before.tick + 1 for before, after in pairwise(log.of(Tick)))
