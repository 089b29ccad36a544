"""The parser of MCAP files finds what other readers read."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from transport.log.parser import Parser

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
