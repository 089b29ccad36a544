"""Messages missing from a log show as gaps in the sequence numbers of the others."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
import tomli_w
from msgspec import structs

from tests.support import runs
from tests.support.logs import log_of
from tests.support.troubles import FAULTS, RESILIENT
from transport.log.missing_messages import missing
from transport.log.run_log import read_log
from transport.log.writer import LogWriter
from transport.protocol.wire.messages import FaultNote, Message, PlantState, Rejected
from transport.report.report import write_report

TICKS = 30


@pytest.fixture(scope="module")
def flight() -> list[Message]:
    """Every message of a short run without faults."""
    return runs.recorded(runs.setup(runs.SHORT))


def without(messages: list[Message], gone: Callable[[Message], bool]) -> str:
    """Return the sentence about a log that lacks some messages."""
    return missing(log_of([message for message in messages if not gone(message)]), None)


def test_a_whole_log(flight: list[Message]) -> None:
    """Nothing is missing from a whole log, an empty one, or one with notes of faults and rejections."""
    assert missing(log_of(flight), None) == ""
    assert missing(log_of([]), None) == ""
    head = {"incarnation": 0, "sequence": 7, "tick": 3}
    note = FaultNote(sender="recorder", target="agent1", what="killed", origin="person", **head)
    refusal = Rejected(
        sender="agent1", offender="agent2", reason="past", count=1, example="", **head
    )
    assert missing(log_of([note, *flight, refusal]), None) == ""


def test_a_restarted_agent_leaves_no_gap() -> None:
    """The end of one incarnation is no gap, and the next one counts from 0."""
    assert missing(log_of(runs.recorded(runs.setup(runs.SHORT, *RESILIENT, *FAULTS))), None) == ""


def test_a_standstill_of_the_recorder(flight: list[Message]) -> None:
    """Messages sent while the recorder was stopped are reported by tick, two stops by first and last."""
    assert (
        without(flight, lambda m: 10 < m.tick < 20)
        == "some messages of ticks 10 to 20 did not reach the recorder"
    )
    twice = without(flight, lambda m: m.tick in (5, 6, 12))
    assert twice == "some messages of ticks 4 to 13 did not reach the recorder"


def test_a_plant_whose_messages_stop(flight: list[Message]) -> None:
    """The plant simulated every tick that others measured, and all ticks of a completed run."""
    plants = {"plant_state", "measurement"}
    silent = without(flight, lambda m: m.kind in plants and m.tick >= 12)
    assert silent == "some messages of ticks 12 to 29 did not reach the recorder"
    unended = without(flight, lambda m: (m.kind in plants and m.tick >= 12) or m.kind == "control")
    assert unended == "some messages of ticks 12 to 28 did not reach the recorder"
    # Ticks that a killed plant did not simulate are not missing.
    assert (
        without(flight, lambda m: m.tick >= 12 or (isinstance(m, PlantState) and m.tick == 11))
        == ""
    )


def test_an_agent_whose_messages_stop(flight: list[Message]) -> None:
    """Plans that the plant followed are missing, although no number of the agent's messages is."""
    silent = without(flight, lambda m: m.sender == "agent1" and m.tick >= 12)
    assert silent == "some messages of ticks 12 to 29 did not reach the recorder"


def test_a_member_whose_late_plans_are_not_followed(flight: list[Message]) -> None:
    """In real time a member that is silent for longer than the coordinator's timeout has gaps."""
    unfollowed = [
        structs.replace(message, plan_ticks=(-2,) * len(message.plan_ticks))
        if isinstance(message, PlantState)
        else message
        for message in flight
        if not (message.sender == "agent1" and message.tick >= 12)
    ]
    realtime = (runs.SHORT, "clock.mode=realtime")
    for timeout_s, gap in ((0.2, " ticks 12 to 29 "), (5.0, "")):
        run = runs.setup(*realtime, f"clock.barrier_timeout_s={timeout_s}")
        assert gap in missing(log_of(unfollowed), run)
        assert bool(missing(log_of(unfollowed), run)) == bool(gap)


def test_the_summary_says_so(flight: list[Message], tmp_path: Path) -> None:
    """A gap is in the summary's `log_cut`, although the file itself is whole."""
    run = runs.setup(runs.SHORT)
    (tmp_path / "scenario.toml").write_text(tomli_w.dumps(run.scenario.tree()))
    with closing(LogWriter(tmp_path / "run.mcap", {}, period_ns=run.period_ns)) as writer:
        for message in flight:
            if not 10 < message.tick < 20:
                writer.write(message, 0)
    assert read_log(tmp_path / "run.mcap").cut == ""
    summary = write_report(tmp_path, figures=False)
    assert summary["log_cut"] == "some messages of ticks 10 to 20 did not reach the recorder"
    assert summary["ticks"] == TICKS - 9
