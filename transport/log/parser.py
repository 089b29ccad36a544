"""Parser of MCAP files in any state: whole, cut, damaged, or still being written.

The reader of the mcap package stops at the first problem and takes a cut record for a shorter one. Here a record counts
only if all its bytes are there, and a chunk only if its size and checksum are right. A file of another origin may hold
chunks that become thousands of times their size: what a chunk and a file become is bounded.
"""

import struct
import zlib
from collections.abc import Iterator
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Metadata
from mcap.writer import MCAP0_MAGIC

_RECORD = struct.Struct("<BQ")  # opcode, length of the body
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log and publish time, ns; the message data follows
_FOOTER_BYTES = _RECORD.size + 20 + len(MCAP0_MAGIC)  # ends the file

# Largest decompressed chunk, bytes: four of the largest messages.
MOST_CHUNK_BYTES = 16 * 1024 * 1024
# Chunks of a file become at most one largest chunk and this many times the file. Logs become 1.5 times their size.
MOST_TIMES = 20

# Exceptions that a damaged record can cause while it is decoded; lz4 raises RuntimeError.
DAMAGE = (McapError, RuntimeError, zstandard.ZstdError, struct.error, ValueError, MemoryError, OverflowError)


class UnreadableError(Exception):
    """A file that is no MCAP file, or would become too large; the text has the reason."""


class Found(NamedTuple):
    """An entry of a file: its channel, data, and the time at which it was received, ns."""

    channel: Channel
    data: bytes
    received_ns: int


class Parser:
    """Parser of one file, which may grow between two calls of `entries`.

    Attributes:
        metadata: Metadata records by name.
        ended: Whether the data section has come to its proper end.
        damaged: Number of records that cannot be decoded, and of messages of a channel that is not known.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = len(MCAP0_MAGIC)  # of the next record
        self._became = 0
        self._channels: dict[int, Channel] = {}
        self._in_summary: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.ended = False
        self.damaged = 0

    def entries(self) -> Iterator[Found]:
        """Yield the entries of the records that are whole and were not read yet, in the order of the file.

        Raises: OSError: the file cannot be read. UnreadableError: it is no MCAP file, or would become too large.
        """
        with self._path.open("rb") as file:
            start = file.read(len(MCAP0_MAGIC))
            if not MCAP0_MAGIC.startswith(start):
                raise UnreadableError(f"not an MCAP file, it starts with {start!r}")
            if self._offset == len(MCAP0_MAGIC):
                self._read_summary(file)
            most = MOST_CHUNK_BYTES + MOST_TIMES * file.seek(0, SEEK_END)
            for opcode, offset, body in records(file, self._offset):
                if self.ended:
                    return
                self._offset, self.ended = offset + len(body), opcode == Opcode.DATA_END
                try:
                    yield from self._read(opcode, body, most)
                except DAMAGE:
                    self.damaged += 1

    def is_whole(self) -> bool:
        """Return whether the file has its proper end, behind index and summary."""
        with self._path.open("rb") as file:
            return self.ended and _footer(file) is not None

    def _read_summary(self, file: BinaryIO) -> None:
        """Read the channels in the summary at the end, for those whose record is in a damaged chunk."""
        footer = _footer(file)
        for opcode, _, body in records(file, footer.summary_start) if footer and footer.summary_start else ():
            if opcode == Opcode.CHANNEL:
                try:
                    _read_channel(body, self._in_summary)
                except DAMAGE:
                    continue

    def _read(self, opcode: int, body: bytes, most: int) -> Iterator[Found]:
        """Yield the entries of a record of the file.

        Raises: one of `DAMAGE`: it cannot be decoded. UnreadableError: the file becomes larger than `most`, bytes.
        """
        if opcode == Opcode.CHUNK:
            chunk = Chunk.read(_stream(body))
            self._became += chunk.uncompressed_size
            if self._became > most or chunk.uncompressed_size > MOST_CHUNK_BYTES:
                raise UnreadableError(
                    f"a chunk of {len(body):,} bytes becomes {chunk.uncompressed_size:,} (expected at most "
                    f"{MOST_CHUNK_BYTES:,}), all until there {self._became:,} (expected at most {most:,})"
                )
            for code, inner in _records_in(_content(chunk)):
                yield from self._read_small(code, inner)
        else:
            yield from self._read_small(opcode, body)

    def _read_small(self, opcode: int, body: bytes) -> Iterator[Found]:
        """Yield the entry in a record, if it is a message; take note of channels and metadata."""
        if opcode == Opcode.METADATA:
            metadata = Metadata.read(_stream(body))
            self.metadata.setdefault(metadata.name, metadata.metadata)
        elif opcode == Opcode.CHANNEL:
            _read_channel(body, self._channels)
        elif opcode == Opcode.MESSAGE:
            number, _, _, received_ns = _MESSAGE.unpack_from(body)
            channel = self._channels.get(number) or self._in_summary.get(number)
            if channel is None:
                self.damaged += 1
                return
            yield Found(channel, body[_MESSAGE.size :], received_ns)


def records(file: BinaryIO, offset: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield opcode, offset of the body and body of the whole records from an offset on, one in memory at a time.

    Opcode 0 ends the file: file systems leave zeros behind an unfinished one.
    """
    size = file.seek(0, SEEK_END)
    while offset + _RECORD.size <= size:
        file.seek(offset)
        opcode, length = _RECORD.unpack(file.read(_RECORD.size))
        offset += _RECORD.size
        if opcode == 0 or length > size - offset:
            return
        yield opcode, offset, file.read(length)
        offset += length


def _records_in(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and body of the records in a chunk.

    The mcap package calls a function for every number of a record, which takes longer.

    Raises: one of `DAMAGE`: the last record is cut.
    """
    end = 0
    while end < len(content):
        code, length = _RECORD.unpack_from(content, end)
        begin = end + _RECORD.size
        end = begin + length
        if end > len(content):
            raise ValueError(f"record in a chunk: expected at most {len(content) - begin} bytes, got {length}")
        yield code, content[begin:end]


def _content(chunk: Chunk) -> bytes:
    """Return the decompressed content of a chunk, never more than it states.

    Raises: one of `DAMAGE`: it cannot be decompressed, or its size or checksum is wrong.
    """
    size = chunk.uncompressed_size
    if chunk.compression == "lz4":
        content = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "zstd":
        content = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
    else:
        content = chunk.data
    if len(content) != size or (chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc):
        raise ValueError("chunk: its size or checksum is wrong")
    return bytes(content)


def _read_channel(body: bytes, channels: dict[int, Channel]) -> None:
    channel = Channel.read(_stream(body))
    channels.setdefault(channel.id, channel)


def _footer(file: BinaryIO) -> Footer | None:
    """Return the footer of a file with a proper end."""
    if file.seek(0, SEEK_END) < _FOOTER_BYTES:
        return None
    file.seek(-_FOOTER_BYTES, SEEK_END)
    end = file.read()
    opcode, _ = _RECORD.unpack_from(end)
    if opcode != Opcode.FOOTER or not end.endswith(MCAP0_MAGIC):
        return None
    footer: Footer = Footer.read(_stream(end[_RECORD.size :]))
    return footer


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))
