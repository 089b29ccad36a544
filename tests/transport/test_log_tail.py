"""A log read while it is written."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from protocol.messages import Message
from tests import runs
from tests.transport.logs import flown
from transport import log_tail
from transport.log import read_log
from transport.log_tail import Chunks, LogTail, Unread
from transport.mcap_salvage import content_of, frames
from transport.viewer.record import KINDS, LATER, Record


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a short flight."""
    folder = tmp_path_factory.mktemp("tail")
    flown(runs.setup(runs.ticks(8)), folder)
    return folder / "run.mcap"


def same(messages: Sequence[Message | Unread], log: Path) -> bool:
    """Whether these are the messages of a log, bit for bit."""
    return list(map(repr, messages)) == [repr(entry.message) for entry in read_log(log).messages]


@pytest.mark.parametrize("piece", [997, 20_011])
def test_it_reads_what_is_whole(log: Path, tmp_path: Path, piece: int) -> None:
    """Grown by pieces of any size, a log gives each message once, in order, as a reader of the whole sees them."""
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
    """A chunk that cannot be read is left out, and what comes behind it is read."""
    data = bytearray(log.read_bytes())
    first = next(body for opcode, body in frames(bytes(data), len(MCAP0_MAGIC)) if opcode == Opcode.CHUNK)
    data[data.index(first) + len(first) // 2] ^= 0xFF
    (tmp_path / "run.mcap").write_bytes(data)
    messages, whole = LogTail(tmp_path / "run.mcap").read(), read_log(log).messages
    assert 0 < len(messages) < len(whole)
    assert messages[-1].kind == "control"


def test_what_is_read_later_says_the_same(log: Path) -> None:
    """A viewer's record is the same, given all messages or those of its kinds, most of them left for later."""
    taken = LogTail(log, KINDS, LATER).read()
    everything = [entry.message for entry in read_log(log).messages]
    assert {message.kind for message in everything} - {message.kind for message in taken} == {"tick", "measurement"}
    assert {message.kind for message in taken if isinstance(message, Unread)} == {"plan", "report"}
    records = [Record(runs.setup(runs.ticks(8))) for _ in range(2)]
    records[0].add(taken)
    records[1].add(everything)
    said = [
        [
            repr(found(agent, tick))
            for found in (record.plan, record.report)
            for agent in range(1, 6)
            for tick in range(9)
        ]
        for record in records
    ]
    assert said[0] == said[1]
    assert len(set(said[0])) == 1 + 4 * 8 * 2  # four agents, eight ticks; nothing of a fifth or a ninth
    assert repr(records[0].truths) == repr(records[1].truths)


def test_what_is_damaged_is_not_there(log: Path, tmp_path: Path) -> None:
    """What cannot be read when it is asked for was never said: damaged or cut since, gone, or no message at all."""
    path = tmp_path / "run.mcap"
    path.write_bytes(log.read_bytes())
    taken = [message for message in LogTail(path, KINDS, LATER).read() if isinstance(message, Unread)]
    plan = next(message for message in taken if message.kind == "plan")
    report = next(message for message in taken if message.kind == "report")
    at, size = plan.chunk
    whole = log.read_bytes()
    for damaged in (whole[: at + size // 2], whole[:at] + bytes(size) + whole[at + size :]):
        path.write_bytes(damaged)
        assert said(replace(plan, chunks=Chunks(path))) == (None, None)
    assert said(replace(plan, chunks=Chunks(tmp_path / "none.mcap"))) == (None, None)
    others = Chunks(log)
    assert said(replace(plan, chunks=others, inside=report.inside)) == (None, None)
    assert said(replace(plan, chunks=others)) == (plan.tick, None)


def said(message: Unread) -> tuple[int | None, int | None]:
    """Tick of the plan and of the report that a record has, given one message."""
    record = Record(runs.setup(runs.ticks(8)))
    record.add([message])
    found = (record.plan(message.agent, message.tick), record.report(message.agent, message.tick))
    return tuple(None if one is None else one.tick for one in found)  # type: ignore[return-value]


def test_what_is_looked_back_at_is_read_once(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages of one chunk cost one look into the file, and what is kept is not the whole log."""
    read = []

    def unpacked(body: bytes) -> bytes:
        read.append(body)
        return content_of(body)

    taken = [message for message in LogTail(log, KINDS, LATER).read() if isinstance(message, Unread)]
    monkeypatch.setattr(log_tail, "content_of", unpacked)
    monkeypatch.setattr(log_tail, "_CHUNKS", 1)
    for _ in range(2):
        assert all(message.message() is not None for message in taken)
    chunks = {message.chunk for message in taken}
    assert len(chunks) > 1
    assert len(read) == 2 * len(chunks)
