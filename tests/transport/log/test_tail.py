"""A log read while it is written, piece by piece, damaged or replaced."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from tests.support import runs
from tests.support.logs import record_run
from transport.log.parser import records
from transport.log.run_log import LogTail, read_log
from transport.protocol.wire import messages as protocol

TICKS = 40
RUN = runs.setup(runs.ticks(TICKS))


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a short run."""
    folder = tmp_path_factory.mktemp("tail")
    record_run(RUN, folder)
    return folder / "run.mcap"


def same(messages: Sequence[protocol.Message], log: Path) -> bool:
    """Return whether these are the messages of a log, bit for bit."""
    return list(map(repr, messages)) == [repr(entry.message) for entry in read_log(log).messages]


@pytest.mark.parametrize("piece", [997, 20_011])
def test_it_reads_what_is_whole(log: Path, tmp_path: Path, piece: int) -> None:
    """A log that grows by pieces of any size yields each message once, in order, as a reader of the whole file does."""
    growing, data = tmp_path / "run.mcap", log.read_bytes()
    tail, messages = LogTail(growing), []
    assert tail.read() == []
    for end in range(0, len(data) + piece, piece):
        growing.write_bytes(data[:end])
        assert not tail.ended
        messages += tail.read()
        assert tail.read() == []
        if tail.ended:
            break
    assert tail.ended
    assert same(messages, log)
    assert tail.newest_ns == max(entry.received_ns for entry in read_log(log).messages)


def test_damage_costs_what_is_damaged(log: Path, tmp_path: Path) -> None:
    """A damaged chunk is skipped, and the messages behind it are read."""
    data = bytearray(log.read_bytes())
    _, chunk, *_ = (
        record.body
        for record in records(BytesIO(data), len(MCAP0_MAGIC))
        if record.opcode == Opcode.CHUNK and record.body is not None
    )
    data[data.index(chunk) + len(chunk) // 2] ^= 0xFF
    (tmp_path / "run.mcap").write_bytes(data)
    messages, whole = LogTail(tmp_path / "run.mcap").read(), read_log(log).messages
    found, expected = (
        [repr(message) for message in many]
        for many in (messages, [entry.message for entry in whole])
    )
    at = next(i for i, pair in enumerate(zip(found, expected, strict=False)) if pair[0] != pair[1])
    assert found == expected[:at] + expected[at - len(found) :]
    assert 0 < at < len(found) < len(expected)
