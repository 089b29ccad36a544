"""The parser of MCAP files finds what other readers read."""

import struct
import tracemalloc
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lz4.frame import LZ4FrameCompressor
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from zstandard import ZstdCompressor

from transport.log.parser import Parser
from transport.protocol.scenario.bounded_files import MOST_RECORD

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
        (writer.finish if finished else writer.flush)()  # type: ignore[no-untyped-call]
    return path


@pytest.mark.parametrize("compression", list(CompressionType))
def test_it_reads_what_the_library_reads(tmp_path: Path, compression: CompressionType) -> None:
    """Channels, data, times and metadata are those that the reader of the mcap package finds."""
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


# A chunk of this many zeros is 4 MB with LZ4 and 0.1 MB with Zstandard, and takes 1 GB once it is decompressed.
BOMB_BYTES = 1_000_000_000


def bomb(compression: str) -> bytes:
    """Return the chunk of zeros in its compression, without its own claim about its size."""
    block = bytes(4_000_000)
    count = BOMB_BYTES // len(block)
    if compression == "lz4":
        frame = LZ4FrameCompressor()
        parts = [frame.begin(), *(frame.compress(block) for _ in range(count)), frame.flush()]
        return b"".join(parts)

    stream = ZstdCompressor().compressobj(size=BOMB_BYTES)
    return b"".join([*(stream.compress(block) for _ in range(count)), stream.flush()])


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_a_chunk_is_no_larger_than_it_says(tmp_path: Path, compression: str) -> None:
    """A small chunk that would take gigabytes is counted as damaged, and the rest of the file is read."""
    path = written(tmp_path / "run.mcap", 400, CompressionType.NONE, finished=False)
    whole = path.read_bytes()
    data = bomb(compression)
    body = struct.pack("<QQQI", 0, 0, 1000, 0) + struct.pack("<I", len(compression))
    body += compression.encode() + struct.pack("<Q", len(data)) + data
    path.write_bytes(whole + struct.pack("<BQ", Opcode.CHUNK, len(body)) + body)

    undamaged = Parser(written(tmp_path / "other.mcap", 400, CompressionType.NONE, finished=False))
    expected = sum(1 for _ in undamaged.entries())
    parser = Parser(path)
    tracemalloc.start()
    count = sum(1 for _ in parser.entries())
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert count == expected
    assert parser.damaged == 1
    assert most_bytes < 3 * MOST_RECORD  # blocks of the decompressed data, and these joined


def test_a_record_beyond_all_sizes_is_refused(tmp_path: Path) -> None:
    """A record that claims more than any recorder writes is not read, also where the file has that size."""
    path = written(tmp_path / "run.mcap", 10, CompressionType.NONE, finished=False)
    length = MOST_RECORD + 1
    with path.open("ab") as file:
        file.write(struct.pack("<BQ", Opcode.METADATA, length))
        file.truncate(file.tell() + length)
    with pytest.raises(McapError, match=f"expected at most {MOST_RECORD} bytes, got {length}"):
        list(Parser(path).entries())
