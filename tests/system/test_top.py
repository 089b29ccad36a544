"""`transport top`: the table follows from the messages, and watching does not change a bit of the run."""

import io
import json
import os
import signal
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from rich.console import Console
from typer.testing import CliRunner

from tests.support import runs
from tests.support.commands import PATIENCE_S, is_flying, settings, start, transport, wait_for
from tests.support.log_messages import on_reference, report
from tests.support.logs import HEADER, with_scenario
from tests.support.messages import sample
from transport.cli.commands.top import Watch, table_of
from transport.cli.main import app
from transport.log.run_log import read_log
from transport.log.writer import LogWriter
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.setup.cost_of_run import StageCost
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import Message, Rejected

# Long enough on any machine; ended by the test.
LONG = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=9.5,displacement_m=[0,0,-2]}]",
    "clock.speed=0.1",
)


def watched(*settings_: str) -> Watch:
    """Return a watch of the paper's run with some settings, before the first message."""
    return Watch(runs.setup(*settings_))


def test_faults_are_shown() -> None:
    """Agents off the roster and in fail-safe mode are shown with the reason.

    Rejections are counted by receiver.
    """
    watch = watched()
    watch.take(runs.roster())
    watch.take(replace(runs.roster({1: 1, 2: 1, 4: 1}, k=5, version=2), reason="agent3 is gone"))
    assert [watch.state_of(agent) for agent in runs.ALL] == ["-", "-", "off", "-"]
    watch.take(replace(runs.plant_state(watch.setup, 9), plan_ticks=(9, 9, -2, 9)))
    assert watch.state_of(3) == "fail-safe"
    pairs = watched("agents.owned=[[1,2],[3,4]]")
    pairs.take(replace(runs.plant_state(pairs.setup, 9), plan_ticks=(9, 9, 9, -2)))
    assert [pairs.state_of(agent) for agent in (1, 2)] == ["-", "fail-safe"]
    assert watch.content()["agents"][2]["removed"] == 1
    assert list(watch.notices)[-1] == "agent3 is gone"
    for who in ("agent1", "plant"):
        watch.take(
            Rejected(
                sender=who,
                incarnation=0,
                sequence=0,
                tick=9,
                offender="agent3",
                reason="past",
                count=3,
                example="",
            ),
        )
    assert watch.rejections == {"agent1": 3, "plant": 3}
    assert watch.content()["agents"][0]["rejected"] == 3


def test_counts_of_an_agent_follow_from_its_reports() -> None:
    """Step times are the newest and the longest of the last 100; losses, late plans and failures add up."""
    watch = watched()
    times_ms = [9.0, *[2.0] * 98, 5.0]
    fields: list[dict[str, Any]] = [{} for _ in times_ms]
    fields[3] = {"lost": 2, "late": 1}
    fields[7] = {"lost": 1, "fallback": True, "status": "limit"}
    fields[9] = {"status": "limit"}
    for k, (total_ms, others) in enumerate(zip(times_ms, fields, strict=True)):
        watch.take(report(watch.setup, 2, k, times_ms=np.array([*[50.0] * 7, total_ms]), **others))
    before = {"agent": 1, "uavs": [1], "state": "-", "plan_ages": None, "worst_ms": None}
    assert before.items() <= watch.content()["agents"][0].items()
    content = watch.content()["agents"][1]
    times = {"tick": 99, "step_ms": 5.0, "worst_ms": 9.0, "plan_ages": [1, 1, 1]}
    assert times.items() <= content.items()
    assert {
        "lost": 3,
        "late": 1,
        "fallbacks": 1,
        "failures": 2,
        "missed": 0,
    }.items() <= content.items()

    watch.take(report(watch.setup, 2, 100, times_ms=np.array([*[50.0] * 7, 1.0])))
    content = watch.content()["agents"][1]
    assert (content["step_ms"], content["worst_ms"]) == (1.0, 5.0)  # the first of 101 is left out


def test_an_agent_without_a_report_for_more_than_five_ticks_is_silent() -> None:
    """Its last report is of the tick at which the five begin."""
    watch = watched()
    watch.take(runs.roster())
    watch.take(report(watch.setup, 2, 4))
    for k, expected in ((4, "active"), (9, "active"), (10, "silent")):
        watch.take(runs.tick(k))
        assert watch.state_of(2) == expected


def test_missed_deadlines_count_in_real_time_between_successive_ticks() -> None:
    """An agent misses a tick if it had no plan when the next one opened.

    Across a gap in the ticks it is unknown; in lockstep the clock waits instead.
    """
    realtime = "clock.mode=realtime", "clock.speed=1", "clock.actuation=next_tick"
    for settings_, expected in ((realtime, [0, 2, 1, 0]), ((), [0, 0, 0, 0])):
        watch = watched(*settings_)
        for k, answered in ((0, ()), (1, (1, 3, 4)), (2, (1, 4)), (5, (1,)), (6, runs.ALL)):
            watch.take(runs.tick(k, answered))
        assert [row["missed"] for row in watch.content()["agents"]] == expected


def test_cost_and_attitude_are_those_of_the_newest_state() -> None:
    """The largest of roll, pitch and yaw, either way, and the cost from the reference of its tick."""
    watch = watched()
    before = watch.content()
    assert (before["tick"], before["time_s"]) == (-1, 0.0)
    assert (before["cost"], before["attitude_deg"]) == (None, None)

    def tilted(x: Array, _: Array) -> None:
        x[state.THETA0] = [0.01, -0.1, 0.05]

    newest = on_reference(watch.setup, 140, tilted)
    for message in (runs.plant_state(watch.setup, 3), runs.tick(140), newest):
        watch.take(message)
    content = watch.content()
    assert content["time_s"] == pytest.approx(7.0)
    assert content["attitude_deg"] == pytest.approx(np.degrees(0.1))
    setup = watch.setup
    y_ref = setup.reference.outputs(np.array([7.0]))[0]
    y = setup.model.outputs(newest.x)
    assert content["cost"] == pytest.approx(StageCost(setup).at(140, y, y_ref, newest.u))
    assert content["cost"] > 0.0


def test_the_table_has_what_is_rare_only_where_it_is() -> None:
    """A row for each agent, then the newest five changes of the roster and who has refused how many messages."""
    watch = watched()
    for version in range(1, 8):
        roster = runs.roster(k=version, version=version)
        watch.take(replace(roster, reason=f"reason {version}"))
    watch.take(runs.tick(20))
    for agent in runs.ALL:
        failed = {"status": "limit", "fallback": True} if agent == 2 else {}
        watch.take(report(watch.setup, agent, 20, **failed))
    watch.take(sample(Rejected, sender="agent3", count=4))

    def lines() -> list[str]:
        console = Console(width=120, file=io.StringIO(), record=True)
        console.print(table_of(watch, "seen"))
        return [line.strip() for line in console.export_text().splitlines()]

    title, progress, _, *agents, first, _, _, _, last, refused = lines()
    assert (title, progress) == ("seen", f"tick 20 of {watch.setup.ticks}, 1.00 of 25.00 s")
    rare = ["", "1 fallbacks, 1 failures", "4 rejected", ""]
    for row, text in zip(agents, rare, strict=True):
        assert "active" in row
        assert row.endswith(text)
        assert any(word in row for word in ("fallbacks", "rejected")) is bool(text)
    assert (first, last, refused) == ("reason 3", "reason 7", "refused by agent3: 4")

    watch.take(runs.plant_state(watch.setup, 20))
    watch.take(replace(runs.end(20), outcome="aborted", reason="by hand"))
    title, progress, *_ = lines()
    assert title == "seen  aborted: by hand"
    assert "attitude 0.00 deg" in progress
    assert watch.content()["outcome"] == "aborted"


def test_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an active run, or with conflicting options, one line says what was expected.

    Exit code 2.
    """
    monkeypatch.chdir(tmp_path)
    for arguments, text in (
        ((), "no active run in runs/"),
        (("--run", "nowhere"), "no such run, neither here nor in"),
        (("--format", "json"), "expected it with --once"),
    ):
        result = CliRunner().invoke(app, ["top", *arguments])
        assert result.exit_code == 2
        assert text in result.output


@pytest.mark.slow
def test_a_run_that_is_watched(tmp_path: Path) -> None:
    """Three commands watch a paced run.

    Once, until Ctrl-C, and to its end; the bits are those of an unwatched run.
    """
    folder = tmp_path / "runs" / "seen"
    run = start("run", "paper", *settings(*LONG), "--out", folder, "--no-figures", cwd=tmp_path)
    try:
        names = ["coordinator", "plant", "agent1", "agent2", "agent3", "agent4"]
        assert wait_for(is_flying(folder, names))
        assert wait_for((folder / "live.json").exists)
        to_the_end = start("top", cwd=tmp_path)
        interrupted = start("top", "--run", "seen", cwd=tmp_path)
        once = transport("top", "--once", "--format", "json", cwd=tmp_path)
        interrupted.send_signal(signal.SIGINT)
        _, errors = interrupted.communicate(timeout=PATIENCE_S)
        assert interrupted.returncode == 130, errors
        assert "Traceback" not in errors
        assert run.poll() is None
        assert wait_for(lambda: gives_way(to_the_end.pid))
    finally:
        run.send_signal(signal.SIGINT)
        _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 130, errors
    output, errors = to_the_end.communicate(timeout=PATIENCE_S)
    assert to_the_end.returncode == 0, errors
    assert "seen  aborted: interrupted (SIGINT)" in output
    assert once.returncode == 0, once.stderr
    content = json.loads(once.stdout)
    assert (content["run"], content["ticks"]) == ("seen", 200)
    assert {agent["state"] for agent in content["agents"]} == {"active"}
    flown = [entry.message for entry in read_log(folder / "run.mcap").messages]
    assert len(bits(flown)) > 0
    assert bits(flown) == bits(runs.recorded(runs.setup(*LONG)))[: len(bits(flown))]


def gives_way(pid: int) -> bool:
    """Return whether `transport top` has found its run: from then on it has a lower priority."""
    own = os.getpriority(os.PRIO_PROCESS, 0)
    return os.getpriority(os.PRIO_PROCESS, pid) > own


def bits(messages: Sequence[Message]) -> list[bytes]:
    """Return the encoded plant states in the order of time."""
    return [encode(plant_state) for plant_state in runs.plant_states(messages)]


def test_the_roster_of_the_first_tick_holds_until_a_roster_is_told() -> None:
    """A run is also watched from its middle on."""
    watch = watched()
    watch.take(runs.tick(3, members=(1, 2, 3)))
    watch.take(runs.tick(4, members=(1, 2)))
    assert watch.members == frozenset({1, 2, 3})
    watch.take(runs.roster({1: 1, 2: 1}, k=4))
    assert watch.members == frozenset({1, 2})
    assert watch.agents[3].removed == 1


@pytest.mark.parametrize(
    ("outcome", "style"), [("completed", "bold green"), ("diverged", "bold red")]
)
def test_the_end_of_a_run_has_a_colour(outcome: str, style: str) -> None:
    """Behind its name."""
    watch = watched()
    watch.take(replace(runs.end(3), outcome=outcome, reason="why"))
    title: Any = table_of(watch, "a run").renderables[0]
    assert title.plain == f"a run  {outcome}: why"
    assert [str(span.style) for span in title.spans] == [style]


@pytest.mark.parametrize("words", [[], ["--once"]])
def test_a_log_without_an_outcome(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its processes were killed: a failure, unless one table was asked for."""
    run = runs.setup()
    header = with_scenario(HEADER, run)
    (tmp_path / "scenario.toml").write_text(header["scenario"], encoding="utf-8")
    with closing(LogWriter(tmp_path / "run.mcap", header, period_ns=run.period_ns)) as writer:
        writer.write(runs.tick(0), 0)
    monkeypatch.setattr(os, "nice", lambda _: 0)
    ended = CliRunner().invoke(app, ["top", "--run", str(tmp_path), *words])
    assert ended.exit_code == (0 if words else 4)
    text = f"transport: {tmp_path}: the log ends without an outcome\n"
    assert ended.stderr == ("" if words else text)
