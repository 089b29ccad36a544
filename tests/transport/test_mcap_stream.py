"""The writer of MCAP files: what it writes is what the mcap package's own does, in memory that does not grow."""

import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import SeekingReader, make_reader
from mcap.records import Chunk, ChunkIndex, DataEnd, Footer, McapRecord, Message, MessageIndex, Schema, SummaryOffset
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from transport.log.mcap_stream import McapStream
from transport.log.salvage import DAMAGE, Salvage, frames, records_of

FRAME_BYTES, CRC_BYTES = 9, 4
CHUNK_BYTES = 2000
METADATA = {"run_id": "r1", "note": "Ω0"}
SCHEMA = b'{"type": "object"}' * 20
# Channels come with their first messages, in the middle of chunks.
CHANNELS = 7

# What may be held more after ten times the messages: a chunk's worth, as it happens to be nearly full or nearly empty.
WAVER_BYTES = 3 * CHUNK_BYTES

Entry = tuple[int, dict[str, Any]]


class Library:
    """The mcap package's writer by the other one's names."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._writer = Writer(
            self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        self._writer.start(library="tests")
        self._writer.add_metadata("run", METADATA)
        self.schema = self._writer.register_schema
        self.channel = self._writer.register_channel
        self.message = self._writer.add_message
        self.flush: Callable[[], None] = self._writer.flush

    def finish(self) -> None:
        """Write the rest."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()


def streamed(path: Path) -> McapStream:
    """The writer under test."""
    stream = McapStream(path, library="tests", chunk_bytes=CHUNK_BYTES)
    stream.metadata("run", METADATA)
    return stream


def entries() -> Iterator[Entry]:
    """Messages without end, as channel and content: empty ones, such as no chunk holds; not in the order of time."""
    rng, number = np.random.default_rng(5), 0
    while True:
        size = 3 * CHUNK_BYTES if number % 100 == 50 else int(rng.choice([0, 2, 50, 300, 500]))
        content = {
            "log_time": 10**9 * (number // 15) + int(rng.integers(10**9)),
            "publish_time": 2**63 - 1 - number,
            "sequence": number if number % 2 else 2**32 - 1 - number,
            "data": rng.bytes(size // 2) + bytes(size // 2),
        }
        yield 1 + int(rng.integers(CHANNELS)), content
        number += 1


def write(maker: McapStream | Library, messages: Iterator[Entry], *, flush_every: int = 10**9) -> None:
    """Add messages, each channel before its first one, with a schema for every three."""
    known = schema = 0
    for number, (channel, content) in enumerate(messages, start=1):
        while known < channel:
            if known % 3 == 0:
                schema = maker.schema(f"schema {known}", "jsonschema", SCHEMA)
            known = maker.channel(f"/topic/{known}", "json", schema)
        maker.message(channel, **content)
        if number % flush_every == 0:
            maker.flush()


def both(folder: Path, count: int, flush_every: int = 10**9) -> tuple[Path, Path]:
    """A file by each writer."""
    ours, theirs = folder / "ours.mcap", folder / "theirs.mcap"
    for maker in (streamed(ours), Library(theirs)):
        write(maker, islice(entries(), count), flush_every=flush_every)
        maker.finish()
    return ours, theirs


def content(path: Path) -> list[McapRecord | tuple[McapRecord, ...]]:
    """The records of a file, without what depends on how well chunks are compressed: sizes, places and checksums."""
    found: list[McapRecord | tuple[McapRecord, ...]] = []
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
            match record:
                case Chunk():
                    found += [replace(record, data=b""), tuple(breakup_chunk(record, validate_crc=True))]
                case ChunkIndex():
                    channels = dict.fromkeys(record.message_index_offsets, 0)
                    found.append(
                        replace(
                            record,
                            chunk_start_offset=0,
                            chunk_length=0,
                            compressed_size=0,
                            message_index_offsets=channels,
                        )
                    )
                case SummaryOffset(group_length=length) if length == 0:
                    pass  # the library's, of attachments nobody has: a group that is not there
                case SummaryOffset():
                    found.append(replace(record, group_start=0))
                case DataEnd():
                    found.append(DataEnd(0))
                case Footer():
                    found.append(Footer(0, 0, 0))
                case _:
                    found.append(record)
    return found


@pytest.mark.parametrize(("count", "flush_every"), [(0, 1), (1, 1), (40, 1), (3000, 10**9), (3000, 17)])
def test_the_library_says_the_same(tmp_path: Path, count: int, flush_every: int) -> None:
    """Record by record the file is the mcap package's: schemas, channels, chunks, indexes, statistics, offsets."""
    ours, theirs = both(tmp_path, count, flush_every)
    assert content(ours) == content(theirs)


def test_places_and_checksums(tmp_path: Path) -> None:
    """Every offset hits its record, every message index its messages; checksums of data and summary are right."""
    path, _ = both(tmp_path, 3000)
    data = path.read_bytes()
    places: dict[int, tuple[int, bytes]] = {}
    at = len(MCAP0_MAGIC)
    for opcode, body in frames(data, at):
        places[at] = opcode, body
        at += FRAME_BYTES + len(body)
    assert at == len(data) - len(MCAP0_MAGIC)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    indexed = 0
    for index in summary.chunk_indexes:
        opcode, body = places[index.chunk_start_offset]
        assert opcode == Opcode.CHUNK
        assert index.chunk_length == FRAME_BYTES + len(body)
        chunk = Chunk.read(ReadDataStream(BytesIO(body)))
        assert index.compressed_size == len(chunk.data)
        inside = zstandard.decompress(chunk.data)
        behind = index.chunk_start_offset + index.chunk_length
        for channel, place in index.message_index_offsets.items():
            assert place == behind
            opcode, body = places[place]
            found = MessageIndex.read(ReadDataStream(BytesIO(body)))
            assert (opcode, found.channel_id) == (Opcode.MESSAGE_INDEX, channel)
            for log_time, offset in found.records:
                opcode, entry = next(frames(inside, offset))
                message = Message.read(ReadDataStream(BytesIO(entry)), len(entry))
                assert (opcode, message.channel_id, message.log_time) == (Opcode.MESSAGE, channel, log_time)
            indexed += len(found.records)
            behind += FRAME_BYTES + len(body)
        assert behind == index.chunk_start_offset + index.chunk_length + index.message_index_length
    assert indexed == 3000
    (end,) = [at for at, (opcode, _) in places.items() if opcode == Opcode.DATA_END]
    assert DataEnd.read(ReadDataStream(BytesIO(places[end][1]))).data_section_crc == zlib.crc32(data[:end])
    foot = max(places)
    footer = Footer.read(ReadDataStream(BytesIO(places[foot][1])))
    assert footer.summary_start == end + FRAME_BYTES + len(places[end][1])
    assert footer.summary_crc == zlib.crc32(data[footer.summary_start : -len(MCAP0_MAGIC) - CRC_BYTES])
    for at, (opcode, body) in places.items():
        if opcode == Opcode.SUMMARY_OFFSET:
            group = SummaryOffset.read(ReadDataStream(BytesIO(body)))
            first, last = group.group_start, group.group_start + group.group_length
            assert {places[at][0] for at in places if first <= at < last} == {group.group_opcode}
            assert first in places
            assert last in places
    offsets = [at for at, (opcode, _) in places.items() if opcode == Opcode.SUMMARY_OFFSET]
    assert footer.summary_offset_start == min(offsets)
    assert len(offsets) == 5  # schemas, channels, statistics, chunks, metadata


def test_chunks_are_read_as_the_library_does(tmp_path: Path) -> None:
    """Every chunk holds for us what it holds for the package, but for schemas; one that is cut inside is no chunk."""
    path, read = both(tmp_path, 400)[0], 0
    with path.open("rb") as file:
        for chunk in StreamReader(file, emit_chunks=True).records:
            if isinstance(chunk, Chunk):
                theirs = [record for record in breakup_chunk(chunk) if not isinstance(record, Schema)]
                assert records_of(Opcode.CHUNK, body_of(chunk)) == theirs
                read += len(theirs)
                cut = replace(chunk, compression="", data=get_chunk_data_stream(chunk)[0].read(10**9)[:-1])
                with pytest.raises(DAMAGE):
                    records_of(Opcode.CHUNK, body_of(replace(cut, uncompressed_crc=0)))
    assert read == 400 + CHANNELS


def body_of(chunk: Chunk) -> bytes:
    """What is written of a chunk behind opcode and length."""
    builder = RecordBuilder()
    chunk.write(builder)
    return bytes(builder.end())[FRAME_BYTES:]  # type: ignore[no-untyped-call]


def test_others_seek_in_it(tmp_path: Path) -> None:
    """The mcap package's reader finds messages by time and topic."""
    path, _ = both(tmp_path, 3000)
    first_ns, last_ns, topics = 50 * 10**9, 90 * 10**9, ["/topic/2", "/topic/5"]
    with path.open("rb") as file:
        reader = make_reader(file)
        assert isinstance(reader, SeekingReader)
        found = [
            message.data
            for _, _, message in reader.iter_messages(
                topics, starting_at=first_ns, ending_before=last_ns, log_time_order=False
            )
        ]
    expected = [
        content["data"]
        for channel, content in islice(entries(), 3000)
        if f"/topic/{channel - 1}" in topics and first_ns <= content["log_time"] < last_ns
    ]
    assert found == expected
    assert len(found) > 100


def test_what_is_flushed_is_in_the_file(tmp_path: Path) -> None:
    """A file that is never finished has all messages up to the last chunk's end, cut at any byte those before it."""
    path, count = tmp_path / "cut.mcap", 200
    stream = streamed(path)
    write(stream, islice(entries(), count), flush_every=count)
    assert stream.is_up_to_date
    stream.abandon()
    data, expected = path.read_bytes(), [content["data"] for _, content in islice(entries(), count)]
    sizes = []
    for end in range(0, len(data) + 1, 97):
        found = Salvage(BytesIO(data[:end]))
        readable = [message.data for _, message in found.entries()]
        assert not found.damaged
        assert readable == expected[: len(readable)]
        sizes.append(len(readable))
    assert sizes == sorted(sizes)
    assert len(list(Salvage(BytesIO(data)).entries())) == count


def test_memory_does_not_grow(tmp_path: Path) -> None:
    """A hundred thousand messages in ten thousand chunks take no more memory than ten thousand messages."""
    stream, messages = streamed(tmp_path / "long.mcap"), cycle(list(islice(entries(), 1000)))
    write(stream, islice(messages, 1000))

    def held(count: int) -> int:
        for channel, content in islice(messages, count):
            stream.message(channel, **content)
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        before = held(10_000)
        after = held(90_000)
    finally:
        tracemalloc.stop()
    stream.finish()
    assert after - before < WAVER_BYTES
