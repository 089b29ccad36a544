"""Reading MCAP files that were cut or damaged: every record that is whole, and what is not.

The reader of the mcap package stops at the first problem, and takes a record cut in the middle for a shorter
one. Here a record counts only when all its bytes are there, and a chunk only when its checksum is right.
"""

import struct
from collections.abc import Iterator
from io import SEEK_END, BytesIO
from typing import BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

_FRAME = struct.Struct("<BQ")  # opcode and length ahead of every record
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, when it was logged and published, ns; then what it says

# What taking a damaged record apart can end in.
DAMAGE = (McapError, zstandard.ZstdError, struct.error, ValueError, MemoryError, OverflowError)


class NotMcapError(ValueError):
    """The bytes do not begin like an MCAP file."""


class Salvage:
    """An MCAP file, taken apart from its beginning to its end, whatever state it is in.

    Args:
        file: Open, at its beginning.

    Attributes, of what has been read so far; of the whole file once `entries` has come to its end:
        metadata: Metadata records by name.
        ended: The file has its proper end.
        data_ended: The part with the messages has its proper end.
        damaged: Records that are there but cannot be read.

    Raises: NotMcapError: it does not begin like one; OSError: it cannot be read.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._size = file.seek(0, SEEK_END)
        file.seek(0)
        start = file.read(len(MCAP0_MAGIC))
        if not MCAP0_MAGIC.startswith(start):
            raise NotMcapError(f"not an MCAP file, it starts with {start!r}")
        self.metadata: dict[str, dict[str, str]] = {}
        self.ended = self.data_ended = False
        self.damaged = 0

    def entries(self) -> Iterator[tuple[str, Message]]:
        """Messages in file order, each with its topic; "" when the channel's record is lost.

        Raises: OSError: the file cannot be read.
        """
        topics: dict[int, str] = {}
        # Channels are repeated at the end of the file. From the first message on whose channel is not known, because
        # its chunk is damaged, all wait for that.
        waiting: list[Message] = []
        footer = False
        for opcode, body in self._frames():
            footer = footer or opcode == Opcode.FOOTER
            self.data_ended = self.data_ended or opcode == Opcode.DATA_END
            try:
                records = records_of(opcode, body)
            except DAMAGE:
                self.damaged += 1
                continue
            for record in records:
                match record:
                    case Metadata():
                        self.metadata[record.name] = record.metadata
                    case Channel():
                        topics.setdefault(record.id, record.topic)
                    case Message() if waiting or record.channel_id not in topics:
                        waiting.append(record)
                    case Message():
                        yield topics[record.channel_id], record
        for message in waiting:
            yield topics.get(message.channel_id, ""), message
        self._file.seek(max(0, self._size - len(MCAP0_MAGIC)))
        self.ended = footer and self._file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC

    def _frames(self) -> Iterator[tuple[int, bytes]]:
        """The whole records behind the magic bytes, as opcode and content, one in memory at a time."""
        while len(head := self._file.read(_FRAME.size)) == _FRAME.size:
            opcode, length = _FRAME.unpack(head)
            if _is_end(opcode, length, self._size - self._file.tell()):
                return
            yield opcode, self._file.read(length)


def frames(data: bytes, at: int) -> Iterator[tuple[int, bytes]]:
    """The whole records from an offset on, as opcode and content."""
    while at + _FRAME.size <= len(data):
        opcode, length = _FRAME.unpack_from(data, at)
        at += _FRAME.size
        if _is_end(opcode, length, len(data) - at):
            return
        yield opcode, data[at : at + length]
        at += length


def _is_end(opcode: int, length: int, left: int) -> bool:
    """Whether what is left is no whole record. Opcode 0 is none: file systems leave zeros where they did not finish."""
    return opcode == 0 or length > left


def records_of(opcode: int, body: bytes) -> list[McapRecord]:
    """What a record says: channels and messages inside a chunk, itself, or nothing for one of no interest here.

    Raises: one of `DAMAGE`: it cannot be read.
    """
    if opcode == Opcode.CHUNK:
        data = content_of(body)
        return [
            record
            for code, begin, end in contents(data)
            if code in (Opcode.CHANNEL, Opcode.MESSAGE)
            for record in records_of(code, data[begin:end])
        ]
    stream = ReadDataStream(BytesIO(body))
    if opcode == Opcode.METADATA:
        return [Metadata.read(stream)]
    if opcode == Opcode.CHANNEL:
        return [Channel.read(stream)]
    if opcode == Opcode.MESSAGE:
        channel, sequence, log_ns, publish_ns = MESSAGE_HEAD.unpack_from(body)
        return [Message(channel, log_ns, body[MESSAGE_HEAD.size :], publish_ns, sequence)]
    return []


def content_of(body: bytes) -> bytes:
    """What is packed in a chunk.

    Raises: one of `DAMAGE`: it cannot be unpacked, or its checksum is wrong.
    """
    stream, size = get_chunk_data_stream(Chunk.read(ReadDataStream(BytesIO(body))), validate_crc=True)
    return stream.read(size)


def contents(data: bytes) -> Iterator[tuple[int, int, int]]:
    """The records of a chunk's content: opcode, and from where to where they are in it.

    Args:
        data: As from `content_of`.
    Returns: Of each record its opcode, and where its body begins and ends in `data`, bytes. The mcap package calls a
        function for every number of a record, which takes longer.

    Raises: one of `DAMAGE`: the last is cut.
    """
    at = 0
    while at < len(data):
        opcode, length = _FRAME.unpack_from(data, at)
        begin, at = at + _FRAME.size, at + _FRAME.size + length
        if at > len(data):
            raise ValueError(f"record in a chunk: expected at most {len(data) - begin} bytes, got {length}")
        yield opcode, begin, at
