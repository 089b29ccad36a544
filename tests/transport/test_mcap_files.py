"""MCAP files: complete indexes in memory that does not grow, and readable after any cut."""

import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from itertools import cycle, islice
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
import pytest
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import SeekingReader, make_reader
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream
from mcap.writer import Writer

from transport.log.chunk_indexes import ChunkIndexes
from transport.log.salvage import DAMAGE, MESSAGE_HEADER, Salvage, records

RECORD_HEADER_BYTES = 9
CHUNK_BYTES = 2000
CHANNELS = 7

# Memory that may be held more after ten times the messages: buffers that happen to be nearly full or nearly empty.
BUFFER_BYTES = 100_000

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


def started(file: IO[bytes]) -> Writer:
    """Return a writer with all channels registered."""
    writer = Writer(file, chunk_size=CHUNK_BYTES, enable_data_crcs=True)
    writer.start(library="tests")
    writer.add_metadata("run", {"run_id": "r1", "note": "Ω0"})
    for number in range(CHANNELS):
        writer.register_channel(f"/topic/{number}", "json", writer.register_schema(f"schema {number}", "", b""))
    return writer


def written(count: int, indexes: ChunkIndexes | None = None) -> bytes:
    """Return a finished file."""
    file = BytesIO()
    writer = started(file)
    if indexes is not None:
        indexes.attach(writer)
    for entry in islice(entries(), count):
        writer.add_message(**entry)
    writer.finish()  # type: ignore[no-untyped-call]
    return file.getvalue()


@pytest.mark.parametrize("count", [0, 1, 40, 3000])
def test_indexes_in_a_file_change_no_byte(count: int) -> None:
    """A file written with chunk indexes in a file equals one written by the mcap package alone."""
    assert written(count, ChunkIndexes(BytesIO())) == written(count)


def test_other_readers_seek_by_the_indexes() -> None:
    """The reader of the mcap package finds messages by time and topic."""
    first_ns, last_ns, topics = 50 * 10**9, 90 * 10**9, ["/topic/2", "/topic/5"]
    reader = make_reader(BytesIO(written(3000, ChunkIndexes(BytesIO()))))
    assert isinstance(reader, SeekingReader)
    found = [
        message.data
        for _, _, message in reader.iter_messages(
            topics, starting_at=first_ns, ending_before=last_ns, log_time_order=False
        )
    ]
    expected = [
        entry["data"]
        for entry in islice(entries(), 3000)
        if entry["channel_id"] - 1 in (2, 5) and first_ns <= entry["log_time"] < last_ns
    ]
    assert found == expected
    assert len(found) > 100


@pytest.mark.slow
def test_memory_does_not_grow(tmp_path: Path) -> None:
    """A hundred thousand messages in ten thousand chunks take no more memory than ten thousand messages."""
    messages = cycle(list(islice(entries(), 1000)))
    with (tmp_path / "long.mcap").open("wb") as file, TemporaryFile(dir=tmp_path) as indexes:
        writer = started(file)
        ChunkIndexes(indexes).attach(writer)

        def held(count: int) -> int:
            for entry in islice(messages, count):
                writer.add_message(**entry)
            return tracemalloc.get_traced_memory()[0]

        tracemalloc.start()
        try:
            before = held(10_000)
            after = held(90_000)
        finally:
            tracemalloc.stop()
    assert after - before < BUFFER_BYTES


def test_chunks_are_read_as_the_library_reads_them() -> None:
    """Every chunk holds the same channels and messages for both readers; a chunk cut inside is damaged."""
    read = 0
    for chunk in StreamReader(BytesIO(written(400)), emit_chunks=True).records:
        if isinstance(chunk, Chunk):
            expected = [record for record in breakup_chunk(chunk) if isinstance(record, Channel | Message)]
            found = [(code, data[begin:end]) for code, data, begin, end in records(Opcode.CHUNK, body_of(chunk))]
            messages = [body for code, body in found if code == Opcode.MESSAGE]
            assert len([code for code, _ in found if code in (Opcode.CHANNEL, Opcode.MESSAGE)]) == len(expected)
            assert [body[MESSAGE_HEADER.size :] for body in messages] == [
                record.data for record in expected if isinstance(record, Message)
            ]
            read += len(messages)
            cut = replace(chunk, compression="", data=get_chunk_data_stream(chunk)[0].read(10**9)[:-1])
            with pytest.raises(DAMAGE):
                list(records(Opcode.CHUNK, body_of(replace(cut, uncompressed_crc=0))))
    assert read == 400


def body_of(chunk: Chunk) -> bytes:
    """Return the encoded chunk without opcode and length."""
    builder = RecordBuilder()
    chunk.write(builder)
    return bytes(builder.end())[RECORD_HEADER_BYTES:]  # type: ignore[no-untyped-call]


def test_flushed_messages_are_in_the_file() -> None:
    """A file that is never finished has all flushed messages; cut at any byte, it has a beginning of them."""
    file, count = BytesIO(), 200
    writer = started(file)
    for entry in islice(entries(), count):
        writer.add_message(**entry)
    writer.flush()  # type: ignore[no-untyped-call]
    data, expected = file.getvalue(), [entry["data"] for entry in islice(entries(), count)]
    sizes = []
    for end in range(0, len(data) + 1, 97):
        salvage = Salvage(BytesIO(data[:end]))
        readable = [message.data for _, message in salvage.entries()]
        assert not salvage.damaged
        assert readable == expected[: len(readable)]
        sizes.append(len(readable))
    assert sizes == sorted(sizes)
    assert len(list(Salvage(BytesIO(data)).entries())) == count
