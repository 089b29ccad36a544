"""Writing an MCAP file of any length in constant memory.

The writer of the mcap package keeps an object for the index of each chunk until the end. Here the index of a chunk is
written down with the chunk, in a file without a name beside the log, and copied into the summary at the end.
"""

import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryFile

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Footer, Header, Metadata, MetadataIndex, Schema, Statistics, SummaryOffset
from mcap.writer import MCAP0_MAGIC

from transport.log.mcap_chunk import Chunk

# The fastest level that still takes off two thirds: half the time of zstd's default, and as large a file.
_LEVEL = 1
_PIECE_BYTES = 64 * 1024
_CRC_BYTES = 4

_Record = Header | Metadata | Schema | Channel | DataEnd | Statistics | MetadataIndex | SummaryOffset | Footer


class McapStream:
    """Writes one file. A finished chunk is handed to the system at once: whatever becomes of the writer, it is there.

    Any method but `abandon` may raise OSError: the file cannot be written. What is in it then is all there will be:
    nothing but `abandon` may follow.

    Args:
        path: File to create.
        library: Who writes.
        chunk_bytes: A chunk with more than that, before compression, is finished.
    """

    def __init__(self, path: Path, *, library: str, chunk_bytes: int) -> None:
        self._chunk_bytes = chunk_bytes
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: Counter[int] = Counter()  # messages by channel
        self._times: tuple[int, int] | None = None  # least and largest log time
        self._chunk, self._chunks = Chunk(), 0
        self._size, self._crc = 0, 0  # of what is written, and its checksum
        with ExitStack() as opened:
            self._file = opened.enter_context(path.open("wb"))
            self._indexes = opened.enter_context(TemporaryFile(dir=path.parent))
            self._write(MCAP0_MAGIC + _bytes([Header(profile="", library=library)]))
            self._file.flush()
            opened.pop_all()

    @property
    def is_up_to_date(self) -> bool:
        """Whether all messages are in finished chunks."""
        return not self._chunk.has_messages

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record."""
        data = _bytes([Metadata(name=name, metadata=dict(values))])
        self._metadata.append(MetadataIndex(offset=self._size, length=len(data), name=name))
        self._write(data)
        self._file.flush()

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; returns its id."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._add(schema)
        return schema.id

    def channel(self, topic: str, encoding: str, schema: int) -> int:
        """Add a channel of messages of a schema; returns its id."""
        number = len(self._channels) + 1
        channel = Channel(id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=schema)
        self._channels.append(channel)
        self._add(channel)
        return number

    def message(self, channel: int, *, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        """Add a message of a channel; times in ns, the sequence number less than 2^32."""
        self._chunk.message(channel, log_time, publish_time, sequence, data)
        if len(self._chunk) > self._chunk_bytes:
            self.flush()

    def flush(self) -> None:
        """Finish the chunk in the making, unless it has no messages."""
        chunk = self._chunk
        if not chunk.has_messages:
            return
        packed = chunk.packed(self._compressor, self._size)
        self._write(packed.records)
        self._file.flush()
        self._indexes.write(packed.index)
        self._counts.update(dict(chunk.counts()))
        first, last = self._times or (chunk.first_time, chunk.last_time)
        self._times = min(first, chunk.first_time), max(last, chunk.last_time)
        self._chunk, self._chunks = Chunk(), self._chunks + 1

    def finish(self) -> None:
        """Write the rest and the summary, and close the file."""
        self.flush()
        self._write(_bytes([DataEnd(data_section_crc=self._crc)]))
        summary, self._crc = self._size, 0
        groups: list[SummaryOffset] = []
        for opcode, pieces in self._summary():
            start = self._size
            for piece in pieces:
                self._write(piece)
            if self._size > start:
                groups.append(SummaryOffset(group_opcode=opcode, group_start=start, group_length=self._size - start))
        footer = Footer(summary_start=summary, summary_offset_start=self._size, summary_crc=0)
        self._write(_bytes(groups))
        footer.summary_crc = zlib.crc32(_bytes([footer])[:-_CRC_BYTES], self._crc)  # covers itself up to there
        self._write(_bytes([footer]) + MCAP0_MAGIC)
        self._indexes.close()
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        for file in (self._indexes, self._file):
            with suppress(OSError):  # what could not be written before cannot be now
                file.close()

    def _add(self, record: Schema | Channel) -> None:
        self._chunk.add(_bytes([record]))
        if len(self._chunk) > self._chunk_bytes:
            self.flush()

    def _summary(self) -> Iterator[tuple[Opcode, Iterable[bytes]]]:
        first, last = self._times or (0, 0)
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunks,
            message_count=self._counts.total(),
            message_start_time=first,
            message_end_time=last,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        yield Opcode.SCHEMA, [_bytes(self._schemas)]
        yield Opcode.CHANNEL, [_bytes(self._channels)]
        yield Opcode.STATISTICS, [_bytes([statistics])]
        self._indexes.seek(0)
        yield Opcode.CHUNK_INDEX, iter(lambda: self._indexes.read(_PIECE_BYTES), b"")
        yield Opcode.METADATA_INDEX, [_bytes(self._metadata)]

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._crc = zlib.crc32(data, self._crc)
        self._size += len(data)


def _bytes(records: Iterable[_Record]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
