"""Parser of MCAP files that may be cut, damaged or still being written.

The mcap package would stop or err at such files.

Sizes are bounded before anything is read or decompressed: a small file can claim or unpack to
terabytes.
"""

import struct
from collections.abc import Iterator
from dataclasses import replace
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from transport.protocol.wire.codec import MAX_BYTES

# Largest record, chunk before compression, and summary: one message of the largest size, and as
# much again for the other messages of its chunk. Chunks of `transport.log.writer` end at 64 KiB.
MOST_BYTES = 2 * MAX_BYTES

_RECORD = struct.Struct("<BQ")  # opcode, length of the body
# Footer of a file: opcode and length of the record, begin of the summary, begin of the summary's
# offsets, checksum, and the magic bytes that end the file.
_FOOTER = struct.Struct("<BQQQI8s")


class LogRecord(NamedTuple):
    """One record of a file."""

    opcode: int
    end: int  # offset of the next record
    body: bytes | None  # None if it is longer than `MOST_BYTES`


class Parser:
    """Parser of one file, which may grow between two calls of `entries`.

    Attributes:
        metadata: Metadata records by name.
        ended: Whether the data section has come to its proper end.
        damaged: Number of records that cannot be decoded or are too large, and of messages whose
            channel is not described.
    """

    def __init__(self, path: Path) -> None:
        self.metadata: dict[str, dict[str, str]] = {}
        self.ended = False
        self.damaged = 0
        self._path = path
        self._offset = len(MCAP0_MAGIC)  # of the next record
        self._channels: dict[int, Channel] = {}

    def entries(self) -> Iterator[tuple[Channel, Message]]:
        """Yield the messages of the whole chunks not read yet, in order.

        Raises: OSError. McapError: no MCAP file.
        """
        with self._path.open("rb") as file:
            start = file.read(len(MCAP0_MAGIC))
            if not MCAP0_MAGIC.startswith(start):
                raise McapError(f"not an MCAP file, it starts with {start!r}")

            for record in records(file, self._offset):
                if self.ended:
                    return
                self._offset = record.end
                self.ended = record.opcode == Opcode.DATA_END
                yield from self._messages_of(record)

    def is_whole(self) -> bool:
        """Return whether the file has its proper end, behind index and summary."""
        return self.ended and self._summary() is not None

    def _messages_of(self, record: LogRecord) -> Iterator[tuple[Channel, Message]]:
        """Yield the messages of a record with their channels; count what cannot be decoded."""
        try:
            parts = self._parts(record)
        except Exception:  # noqa: BLE001  # damaged bytes raise any exception
            self.damaged += 1
            return

        self._channels |= {part.id: part for part in parts if isinstance(part, Channel)}

        for part in parts:
            if not isinstance(part, Message):
                continue
            channel = self._channel(part.channel_id)
            if channel is None:
                self.damaged += 1
            else:
                yield channel, part

    def _parts(self, record: LogRecord) -> list[Any]:
        """Return the records in a chunk, none for other records; take note of metadata."""
        if record.opcode not in (Opcode.METADATA, Opcode.CHUNK):
            return []
        if record.body is None:
            raise McapError(f"a record of more than {MOST_BYTES} bytes")

        stream = ReadDataStream(BytesIO(record.body))
        if record.opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            self.metadata.setdefault(metadata.name, metadata.metadata)
            return []
        return breakup_chunk(_decompressed(Chunk.read(stream)), validate_crc=True)

    def _channel(self, number: int) -> Channel | None:
        """Return a channel; one whose record is in a damaged chunk is in the summary as well."""
        if number not in self._channels:
            summary = self._summary()
            self._channels |= {} if summary is None else summary.channels
        return self._channels.get(number)

    def _summary(self) -> Summary | None:
        """Return the summary of a file with a proper end; otherwise None."""
        try:
            with self._path.open("rb") as file:
                size = file.seek(0, SEEK_END)
                file.seek(size - _FOOTER.size)
                summary_begin = _FOOTER.unpack(file.read(_FOOTER.size))[2]
                if size - summary_begin > MOST_BYTES:
                    return None

                file.seek(0)
                return make_reader(file).get_summary()
        except Exception:  # noqa: BLE001  # no end, or a damaged one
            return None


def records(file: BinaryIO, offset: int) -> Iterator[LogRecord]:
    """Yield the whole records from an offset on, in order."""
    size = file.seek(0, SEEK_END)
    while offset + _RECORD.size <= size:
        file.seek(offset)
        opcode, length = _RECORD.unpack(file.read(_RECORD.size))
        body_begin = offset + _RECORD.size

        # File systems leave zeros behind an unfinished file.
        is_unfinished = opcode == 0 or length > size - body_begin
        if is_unfinished:
            return

        offset = body_begin + length
        yield LogRecord(opcode, offset, file.read(length) if length <= MOST_BYTES else None)


def _decompressed(chunk: Chunk) -> Chunk:
    """Return a chunk with its content as it was before compression.

    Raises: McapError: it is larger than `MOST_BYTES`, or not as large as it claims, or its
        compression is unknown. Errors of the compression.
    """
    if chunk.uncompressed_size > MOST_BYTES:
        raise McapError(f"a chunk of more than {MOST_BYTES} bytes")
    one_too_many = chunk.uncompressed_size + 1

    match chunk.compression:
        case "":
            content = chunk.data
        case "lz4":
            decompressor = lz4.frame.LZ4FrameDecompressor()
            content = decompressor.decompress(chunk.data, max_length=one_too_many)
        case "zstd":
            content = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(one_too_many)
        case _:
            raise McapError(f"unknown compression {chunk.compression!r}")

    if len(content) != chunk.uncompressed_size:
        raise McapError(f"expected a chunk of {chunk.uncompressed_size} bytes")
    return replace(chunk, compression="", data=content)
