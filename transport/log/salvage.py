"""Reading MCAP files that were cut or damaged: every record that is whole, and the number of those that are not.

The reader of the mcap package stops at the first problem and takes a cut record for a shorter one. Here a record counts
only if all its bytes are there, and a chunk only if its checksum is right.
"""

import struct
from collections.abc import Iterator
from io import SEEK_END, BytesIO
from typing import BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

_RECORD_HEADER = struct.Struct("<BQ")  # opcode, length of the body
MESSAGE_HEADER = struct.Struct("<HIQQ")  # channel, sequence, log and publish time, ns; the message data follows

# Exceptions that a damaged record can cause while it is decoded; lz4 raises RuntimeError.
DAMAGE = (McapError, RuntimeError, zstandard.ZstdError, struct.error, ValueError, MemoryError, OverflowError)


# Channel of messages whose channel record is damaged.
LOST = Channel(id=0, topic="", message_encoding="", metadata={}, schema_id=0)


class NotMcapError(ValueError):
    """The file does not begin like an MCAP file."""


class Salvage:
    """Reader of an MCAP file in any state, from its beginning to its end.

    Args:
        file: Open, at its beginning.

    Attributes, final once `entries` is exhausted:
        metadata: Metadata records by name.
        ended: The file has its proper end.
        data_ended: The data section has its proper end.
        damaged: Number of records that cannot be decoded.

    Raises: NotMcapError: it does not begin like one; OSError: it cannot be read.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        start = file.read(len(MCAP0_MAGIC))
        if not MCAP0_MAGIC.startswith(start):
            raise NotMcapError(f"not an MCAP file, it starts with {start!r}")
        self.metadata: dict[str, dict[str, str]] = {}
        self.ended = self.data_ended = False
        self.damaged = 0

    def entries(self) -> Iterator[tuple[Channel, Message]]:
        """Yield the messages in file order, each with its channel; `LOST` if the record of that is lost.

        Raises: OSError: the file cannot be read.
        """
        channels: dict[int, Channel] = {}
        # A damaged chunk may hold the only channel record ahead of the summary. From the first message of an unknown
        # channel on, all messages wait for the summary, which keeps their order.
        waiting: list[Message] = []
        footer_end = -1
        for opcode, offset, body in frames(self._file):
            if opcode == Opcode.FOOTER:
                footer_end = offset + len(body)
            self.data_ended = self.data_ended or opcode == Opcode.DATA_END
            try:
                for code, data, begin, end in records(opcode, body):
                    if code == Opcode.METADATA:
                        metadata = Metadata.read(_stream(data[begin:end]))
                        self.metadata[metadata.name] = metadata.metadata
                    elif code == Opcode.CHANNEL:
                        channel = Channel.read(_stream(data[begin:end]))
                        channels.setdefault(channel.id, channel)
                    elif code == Opcode.MESSAGE:
                        content = data[begin:end]
                        number, sequence, log_ns, publish_ns = MESSAGE_HEADER.unpack_from(content)
                        message = Message(number, log_ns, content[MESSAGE_HEADER.size :], publish_ns, sequence)
                        if waiting or number not in channels:
                            waiting.append(message)
                        else:
                            yield channels[number], message
            except DAMAGE:
                self.damaged += 1
        for message in waiting:
            yield channels.get(message.channel_id, LOST), message
        if footer_end >= 0:
            self._file.seek(-len(MCAP0_MAGIC), SEEK_END)
            self.ended = self._file.read() == MCAP0_MAGIC


def frames(file: BinaryIO) -> Iterator[tuple[int, int, bytes]]:
    """Yield the whole records from the current position on, one in memory at a time.

    The caller must not move the position meanwhile. Opcode 0 ends the file: file systems leave zeros behind an
    unfinished one.

    Yields: Opcode, offset of the body in the file, body.
    Raises: OSError: the file cannot be read.
    """
    offset = file.tell()
    size = file.seek(0, SEEK_END)
    file.seek(offset)
    while len(header := file.read(_RECORD_HEADER.size)) == _RECORD_HEADER.size:
        opcode, length = _RECORD_HEADER.unpack(header)
        offset += _RECORD_HEADER.size
        if opcode == 0 or length > size - offset:
            return
        yield opcode, offset, file.read(length)
        offset += length


def records(opcode: int, body: bytes) -> Iterator[tuple[int, bytes, int, int]]:
    """Yield the records in a chunk; any other record yields itself.

    The mcap package calls a function for every number of a record, which takes longer.

    Yields: Opcode, bytes that hold the body of the record, and where the body begins and ends in them.
    Raises: one of `DAMAGE`: the chunk cannot be decompressed, its checksum is wrong, or its last record is cut.
    """
    if opcode != Opcode.CHUNK:
        yield opcode, body, 0, len(body)
        return
    data, end = chunk_content(body), 0
    while end < len(data):
        code, length = _RECORD_HEADER.unpack_from(data, end)
        begin = end + _RECORD_HEADER.size
        end = begin + length
        if end > len(data):
            raise ValueError(f"record in a chunk: expected at most {len(data) - begin} bytes, got {length}")
        yield code, data, begin, end


def chunk_content(body: bytes) -> bytes:
    """Return the decompressed content of a chunk.

    Raises: one of `DAMAGE`: it cannot be decompressed, or its checksum is wrong.
    """
    stream, size = get_chunk_data_stream(Chunk.read(_stream(body)), validate_crc=True)
    return stream.read(size)


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))
