"""A log holds what came; who reads it sees what a receiver of the run would have accepted."""

from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import runs
from tests.support.logs import HEADER, with_scenario
from transport.log.run_log import LogTail, RunLog, read_log
from transport.log.writer import LogWriter
from transport.protocol.wire.codec import encode, header_of
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.messages import Message, Plan, Rejected

TICKS = 30
RUN = runs.setup("controller.horizon=5", runs.ticks(TICKS))
KEYS = Keys("log")

Entry = tuple[str, bytes]


@pytest.fixture(scope="module")
def flight() -> list[Message]:
    """Every message of a short run."""
    return runs.recorded(RUN)


def entry(message: Message) -> Entry:
    """Return the key, without prefix, and the bytes of a message that came alone."""
    return KEYS.end(KEYS.of(message)), encode(message)


def write(path: Path, entries: Sequence[Entry]) -> Path:
    """Write the log of entries as they came, 1 ms apart."""
    with closing(LogWriter(path, with_scenario(HEADER, RUN), period_ns=RUN.period_ns)) as writer:
        header = header_of(entries[0][1])
        for number, (key, data) in enumerate(entries):
            with suppress(MessageError):  # a garbled entry has the header of the one before
                header = header_of(data)
            writer.add(f"/{key}", data, header, 1_000_000 * number)
    return path


def accepted(log: RunLog) -> set[bytes]:
    """Return the messages of a log but notices of refusals, as bytes."""
    return {
        encode(entry.message) for entry in log.messages if not isinstance(entry.message, Rejected)
    }


def refused(log: RunLog) -> dict[tuple[str, str], int]:
    """Return how many messages were refused in the name of the recorder, by sender and reason."""
    counts: dict[tuple[str, str], int] = {}
    for notice in log.of(Rejected):
        assert notice.sender == "recorder"
        at = notice.offender, notice.reason
        counts[at] = counts.get(at, 0) + notice.count
    return counts


def test_bad_messages_change_nothing(tmp_path: Path, flight: list[Message]) -> None:
    """Garbled, repeated, forged and implausible messages are counted and shut out none, whether before or after it."""
    said = [entry(message) for message in flight]
    at = len(said) // 2
    key, data = said[at]
    plan = next(
        message for message in flight if isinstance(message, Plan) and message.tick == TICKS - 1
    )
    absurd = replace(plan, inputs=plan.inputs * 0.0 + 1e5)
    garbled = data[:-20] + bytes(np.random.default_rng(3).integers(0, 256, 20, dtype=np.uint8))
    bad = [
        (key, data[: len(data) // 2]),
        said[at - 1],
        said[3],
        entry(replace(plan, sender="agent3")),
        entry(absurd),
    ]
    disturbed = [*said[:at], (key, garbled), said[at], *bad, *said[at + 1 :]]
    log = read_log(write(tmp_path / "run.mcap", disturbed))
    assert accepted(log) == {encode(message) for message in flight}
    counts = refused(log)
    assert counts.pop((plan.sender, "outside_limits")) == 1
    assert counts.pop(("agent3", "wrong_sender")) == 1
    assert {reason for _, reason in counts} >= {"replayed"}
    assert sum(counts.values()) >= 3
    # The first is told at once, those of the second after it at the end of the log.
    noted_ns = [one.received_ns for one in log.messages if isinstance(one.message, Rejected)]
    assert (noted_ns[0], noted_ns[-1]) == (1_000_000 * at, 1_000_000 * (len(disturbed) - 1))
    tail = [
        message
        for message in LogTail(tmp_path / "run.mcap").read()
        if not isinstance(message, Rejected)
    ]
    assert {encode(message) for message in tail if isinstance(message, Message)} == accepted(log)
