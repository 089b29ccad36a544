"""The parser of MCAP files finds what other readers read."""

import struct
import tracemalloc
from collections.abc import Callable, Iterator
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from transport.log.parser import MOST_BYTES, Parser, records

CHUNK_BYTES = 2000
CHANNELS = 7

Entry = dict[str, Any]


def entries() -> Iterator[Entry]:
    """Yield messages without end: some empty, some larger than a chunk, not in the order of time."""
    rng, number = np.random.default_rng(5), 0
    while True:
        size = 3 * CHUNK_BYTES if number % 100 == 50 else int(rng.choice([0, 2, 50, 300, 500]))
        yield {
            "channel_id": 1 + int(rng.integers(CHANNELS)),
            "log_time": 10**9 * (number // 15) + int(rng.integers(10**9)),
            "publish_time": 2**63 - 1 - number,
            "sequence": number if number % 2 else 2**32 - 1 - number,
            "data": rng.bytes(size // 2) + bytes(size // 2),
        }
        number += 1


def written(path: Path, count: int, compression: CompressionType, *, finished: bool = True) -> Path:
    """Return a file of `entries`."""
    with path.open("wb") as file:
        writer = Writer(
            file, chunk_size=CHUNK_BYTES, compression=compression, enable_data_crcs=True
        )
        writer.start(library="tests")
        writer.add_metadata("run", {"run_id": "r1", "note": "Ω0"})
        for number in range(CHANNELS):
            writer.register_channel(
                f"/topic/{number}", "json", writer.register_schema(f"schema {number}", "", b"")
            )
        for entry in islice(entries(), count):
            writer.add_message(**entry)
        writer.add_metadata("run", {"run_id": "later"})
        (writer.finish if finished else writer.flush)()  # type: ignore[no-untyped-call]
    return path


@pytest.mark.parametrize("compression", list(CompressionType))
def test_it_reads_what_the_library_reads(tmp_path: Path, compression: CompressionType) -> None:
    """Channels, data and times are those that the reader of the mcap package finds; metadata of a name the first."""
    path = written(tmp_path / "run.mcap", 400, compression)
    parser = Parser(path)
    found = [(channel.topic, entry.data, entry.publish_time) for channel, entry in parser.entries()]
    with path.open("rb") as file:
        expected = [
            (channel.topic, message.data, message.publish_time)
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]
    assert found == expected
    assert len(found) == 400
    assert (parser.damaged, parser.is_whole()) == (0, True)
    assert parser.metadata == {"run": {"run_id": "r1", "note": "Ω0"}}


def test_channels_of_a_damaged_chunk_are_in_the_summary(tmp_path: Path) -> None:
    """They are described in the first one alone; messages behind it are read."""
    path = written(tmp_path / "run.mcap", 400, CompressionType.LZ4)
    whole = [(channel.topic, entry.data) for channel, entry in Parser(path).entries()]
    data = bytearray(path.read_bytes())
    chunks = [
        record
        for record in records(BytesIO(data), len(MCAP0_MAGIC))
        if record.opcode == Opcode.CHUNK
    ]
    data[chunks[0].end - 20] ^= 0xFF
    path.write_bytes(data)

    parser = Parser(path)
    found = [(channel.topic, entry.data) for channel, entry in parser.entries()]
    assert 0 < len(found) < len(whole)
    assert found == whole[-len(found) :]
    assert parser.damaged == 1


# Content of a chunk that unpacks to far more than any chunk of a run.
BOMB_BYTES = 8 * MOST_BYTES
# Memory of a reader: bytes and records of the largest chunk, each some times.
READER_BYTES = 4 * MOST_BYTES


def chunk(content: bytes, compression: str, claimed_bytes: int) -> bytes:
    """Return a chunk record that claims a size of its content before compression."""
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, claimed_bytes, 0, len(name)) + name
    body += struct.pack("<Q", len(content)) + content
    return struct.pack("<BQ", Opcode.CHUNK, len(body)) + body


@pytest.mark.parametrize("claimed_bytes", [BOMB_BYTES, 100])
@pytest.mark.parametrize(
    ("compression", "compress"),
    [("lz4", lz4.frame.compress), ("zstd", zstandard.compress)],
)
def test_a_chunk_that_unpacks_to_a_bomb_is_damage(
    tmp_path: Path, compression: str, compress: Callable[[bytes], bytes], claimed_bytes: int
) -> None:
    """Its size is bounded before it is unpacked, also if it claims less; the chunks behind it are read."""
    path = written(tmp_path / "run.mcap", 100, CompressionType.LZ4)
    bomb = chunk(compress(bytes(BOMB_BYTES)), compression, claimed_bytes)
    whole = path.read_bytes()
    begin = len(MCAP0_MAGIC)
    path.write_bytes(whole[:begin] + bomb + whole[begin:])

    parser = Parser(path)
    tracemalloc.start()
    count = sum(1 for _ in parser.entries())
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert (count, parser.damaged) == (100, 1)
    assert peak_bytes < READER_BYTES


MESSAGE = struct.pack("<BQHIQQ", Opcode.MESSAGE, 30, 1, 0, 0, 0) + bytes(8)


@pytest.mark.parametrize(("claimed", "count"), [(1, 9), (2, 11), (3, 9)])
@pytest.mark.parametrize(
    ("compression", "compress"),
    [("", bytes), ("lz4", lz4.frame.compress), ("zstd", zstandard.compress)],
)
def test_a_chunk_is_as_large_as_it_claims(
    tmp_path: Path,
    compression: str,
    compress: Callable[[bytes], bytes],
    claimed: int,
    count: int,
) -> None:
    """A chunk of two messages that claims the size of one or of three is damage, not cut to whole messages."""
    path = written(tmp_path / "run.mcap", 9, CompressionType.LZ4, finished=False)
    own = chunk(compress(2 * MESSAGE), compression, claimed * len(MESSAGE))
    path.write_bytes(path.read_bytes() + own)

    parser = Parser(path)
    assert sum(1 for _ in parser.entries()) == count
    assert parser.damaged == (claimed != 2)


@pytest.mark.parametrize("count", [100, 101])
def test_the_largest_chunk_that_is_read(
    tmp_path: Path, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A chunk of the most bytes before compression is read, a larger one is damage."""
    monkeypatch.setattr("transport.log.parser.MOST_BYTES", 100 * len(MESSAGE))
    path = written(tmp_path / "run.mcap", 9, CompressionType.LZ4, finished=False)
    own = chunk(lz4.frame.compress(count * MESSAGE), "lz4", count * len(MESSAGE))
    path.write_bytes(path.read_bytes() + own)
    parser = Parser(path)
    assert sum(1 for _ in parser.entries()) == 9 + (count if count == 100 else 0)
    assert parser.damaged == (count == 101)


@pytest.mark.parametrize("less", [0, 1])
def test_the_largest_record_and_summary_that_are_read(
    tmp_path: Path, less: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They have the most bytes; of a longer record only the length is known."""
    path = written(tmp_path / "run.mcap", 9, CompressionType.LZ4)
    data = path.read_bytes()
    (first, *_) = records(BytesIO(data), len(MCAP0_MAGIC))
    assert first.body is not None
    monkeypatch.setattr("transport.log.parser.MOST_BYTES", len(first.body) - less)
    (again, *_) = records(BytesIO(data), len(MCAP0_MAGIC))
    assert (again.body is None, again.end) == (bool(less), first.end)

    monkeypatch.setattr("transport.log.parser.MOST_BYTES", len(data))
    parser = Parser(path)
    assert sum(1 for _ in parser.entries()) == 9
    ends = {one.opcode: one.end for one in records(BytesIO(data), len(MCAP0_MAGIC))}
    monkeypatch.setattr("transport.log.parser.MOST_BYTES", len(data) - ends[Opcode.DATA_END] - less)
    assert parser.is_whole() is (not less)


def test_a_record_of_any_length_is_not_read_whole(tmp_path: Path) -> None:
    """A sparse file with one record of terabytes is passed over: its length is checked before."""
    path = written(tmp_path / "run.mcap", 100, CompressionType.LZ4)
    whole = path.read_bytes()
    length = 2**42
    with path.open("wb") as file:
        file.write(MCAP0_MAGIC + struct.pack("<BQ", Opcode.CHUNK, length))
        file.seek(length, 1)
        file.write(whole[len(MCAP0_MAGIC) :])

    parser = Parser(path)
    count = sum(1 for _ in parser.entries())
    assert (count, parser.damaged, parser.ended) == (100, 1, True)


def test_a_summary_of_any_length_is_not_read(tmp_path: Path) -> None:
    """A footer that points to a summary of terabytes makes the file one without its proper end."""
    path = written(tmp_path / "run.mcap", 100, CompressionType.LZ4)
    whole = path.read_bytes()
    footer = struct.calcsize("<BQQQI8s")
    with path.open("wb") as file:
        file.write(whole[:-footer])
        file.seek(2**42, 1)
        file.write(whole[-footer:])

    parser = Parser(path)
    assert sum(1 for _ in parser.entries()) == 100
    assert not parser.is_whole()
