"""What a log lacks shows in the numbers of the messages it has."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import tomli_w

from protocol.wire.messages import FaultNote, Message, Plan, PlantState, Rejected
from tests.support import runs
from tests.support.logs import log_of
from tests.support.troubles import FAULTS, RESILIENT
from transport.log.gaps import END_NOT_RECORDED, missing
from transport.log.run_log import LogWriter, read_log
from transport.report.report import write_report

TICKS = 30


@pytest.fixture(scope="module")
def flight() -> list[Message]:
    """Every message of a short flight in which nothing happens."""
    return runs.recorded(runs.setup(runs.SHORT))


def without(messages: list[Message], gone: Callable[[Message], bool]) -> str:
    """What is said of the log of a flight that some messages did not get into."""
    return missing(log_of([message for message in messages if not gone(message)]))


def test_a_whole_log(flight: list[Message]) -> None:
    """Nothing is missing from a flight as it was, nor from none, nor when people and refusals have had their say."""
    assert missing(log_of(flight)) == ""
    assert missing(log_of([])) == ""
    head = {"incarnation": 0, "sequence": 7, "tick": 3}
    note = FaultNote(sender="recorder", target="agent1", what="killed", origin="person", **head)
    refusal = Rejected(sender="agent1", offender="agent2", reason="past", count=1, example="", **head)
    assert missing(log_of([note, *flight, refusal])) == ""


def test_who_leaves_and_comes_back_leaves_no_gap() -> None:
    """Last words of a start that is over are not missed, and the next start counts from 0."""
    assert missing(log_of(runs.recorded(runs.setup(runs.SHORT, *RESILIENT, *FAULTS)))) == ""


def test_a_standstill_of_the_recorder(flight: list[Message]) -> None:
    """What was said while the recorder stood still is told by tick; two standstills are two."""
    assert without(flight, lambda m: 10 < m.tick < 20) == "some messages of ticks 10 to 20 did not reach the recorder"
    twice = without(flight, lambda m: m.tick in (5, 6, 12))
    assert twice == "some messages of ticks 4 to 7, 11 to 13 did not reach the recorder"


def test_one_message(flight: list[Message]) -> None:
    """One message of one process is missed, at its tick."""
    lost = without(flight, lambda m: isinstance(m, Plan) and m.agent == 3 and m.tick == 7)
    assert lost == "some messages of ticks 6 to 7 did not reach the recorder"


def test_a_recorder_that_came_late(flight: list[Message]) -> None:
    """Whatever was said before it came is missing."""
    assert without(flight, lambda m: m.tick < 8) == "some messages of ticks 0 to 8 did not reach the recorder"


def test_a_plant_that_is_not_heard_of_any_more(flight: list[Message]) -> None:
    """The plant has flown whatever others say they measured, and everything up to the end of a completed run."""
    plants = {"plant_state", "measurement"}
    silent = without(flight, lambda m: m.kind in plants and m.tick >= 12)
    assert silent == "some messages of ticks 12 to 29 did not reach the recorder"
    unended = without(flight, lambda m: (m.kind in plants and m.tick >= 12) or m.kind == "control")
    assert unended == "some messages of ticks 12 to 28 did not reach the recorder"
    # What a plant that was killed has not flown is not missing: nobody has measured it.
    assert without(flight, lambda m: m.tick >= 12 or (isinstance(m, PlantState) and m.tick == 11)) == ""


def test_an_end_that_was_not_heard(flight: list[Message]) -> None:
    """Of a run whose end the recorder knows of by nothing but the coordinator's exit code, the rest is missing."""
    for reason, said in (("coordinator is gone", ""), (END_NOT_RECORDED, "the rest of the run after tick 11")):
        control = replace(runs.end(11), sender="recorder", outcome="aborted", reason=reason, exit_code=4)
        log = log_of([*(message for message in flight if message.tick < 12), control])
        assert missing(log) == (f"{said} did not reach the recorder" if said else "")


def test_the_summary_says_so(flight: list[Message], tmp_path: Path) -> None:
    """A gap is in the summary's `log_cut`, although the file itself is whole."""
    run = runs.setup(runs.SHORT)
    (tmp_path / "scenario.toml").write_text(tomli_w.dumps(run.scenario.tree()))
    with LogWriter(tmp_path / "run.mcap", {}, period_ns=run.period_ns) as writer:
        for message in flight:
            if not 10 < message.tick < 20:
                writer.write(message, 0)
    assert read_log(tmp_path / "run.mcap").cut == ""
    summary = write_report(tmp_path, figures=False)
    assert summary["log_cut"] == "some messages of ticks 10 to 20 did not reach the recorder"
    assert summary["ticks"] == TICKS - 9
