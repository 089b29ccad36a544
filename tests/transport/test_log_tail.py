"""A log read while it is written, piece by piece, damaged or replaced."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import pytest
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message
from mcap.writer import MCAP0_MAGIC

from protocol.wire import messages as protocol
from protocol.wire.codec import encode
from tests.support import runs
from tests.support.logs import record_run
from transport.log.channels import ENCODING
from transport.log.parser import records
from transport.log.run_log import read_log
from transport.log.tail import LogTail

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


def test_damage_costs_what_is_damaged(log: Path, tmp_path: Path) -> None:
    """A damaged chunk is skipped, and the messages behind it are read."""
    data = bytearray(log.read_bytes())
    _, chunk, *_ = (body for opcode, _, body in records(BytesIO(data), len(MCAP0_MAGIC)) if opcode == Opcode.CHUNK)
    data[data.index(chunk) + len(chunk) // 2] ^= 0xFF
    (tmp_path / "run.mcap").write_bytes(data)
    messages, whole = LogTail(tmp_path / "run.mcap").read(), read_log(log).messages
    found, expected = ([repr(message) for message in many] for many in (messages, [entry.message for entry in whole]))
    at = next(i for i, pair in enumerate(zip(found, expected, strict=False)) if pair[0] != pair[1])
    assert found == expected[:at] + expected[at - len(found) :]
    assert 0 < at < len(found) < len(expected)


def test_one_bad_message_costs_itself(log: Path, tmp_path: Path) -> None:
    """A bad message is skipped, in a chunk or outside; so is one shorter than its header, and a chunk in a chunk."""
    messages = [entry.message for entry in read_log(log).messages if entry.message.kind == "plant_state"][:4]
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        file.write(MCAP0_MAGIC)
        for packed, two in ((True, messages[:2]), (False, messages[2:])):
            builder = RecordBuilder()
            for number, topic, encoding in ((1, "/plant_state", ENCODING), (2, "/tokens", "json")):
                Channel(id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=0).write(builder)
            for number, data in ((2, b"{}"), (1, encode(two[0])), (1, b"{}"), (2, b"[]"), (1, encode(two[1]))):
                Message(channel_id=number, log_time=0, data=data, publish_time=0, sequence=0).write(builder)
            inside = bytes(builder.end())  # type: ignore[no-untyped-call]
            nested = chunk_of(inside)
            file.write(chunk_of(inside + nested) if packed else inside)
        file.write(chunk_of(inside + bytes([Opcode.MESSAGE]) + (4).to_bytes(8, "little") + b"\1\0\0\0"))
    for found in (LogTail(path).read(), [entry.message for entry in read_log(path).messages]):
        assert [message.tick for message in found if not isinstance(message, protocol.Rejected)] == [0, 1, 2, 3]
        refused = [message for message in found if isinstance(message, protocol.Rejected)]
        assert {(notice.offender, notice.reason) for notice in refused} >= {("plant_state", "wrong_version")}


def chunk_of(data: bytes) -> bytes:
    """Return a chunk with this content."""
    builder = RecordBuilder()
    Chunk(
        compression="",
        data=data,
        message_end_time=0,
        message_start_time=0,
        uncompressed_crc=0,
        uncompressed_size=len(data),
    ).write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
