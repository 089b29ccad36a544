"""Reading MCAP files that were cut or damaged: every record that is whole, and what is not.

The reader of the mcap package stops at the first problem, and takes a record cut in the middle for a shorter
one. Here a record counts only when all its bytes are there, and a chunk only when its checksum is right.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

_FRAME = struct.Struct("<BQ")  # opcode and length ahead of every record

# What taking a damaged record apart can end in.
DAMAGE = (McapError, zstandard.ZstdError, struct.error, ValueError, MemoryError, OverflowError)


class NotMcapError(ValueError):
    """The bytes do not begin like an MCAP file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Salvage:
    """What an MCAP file holds.

    Attributes:
        metadata: Metadata records by name.
        entries: Messages in file order, each with its topic; "" when the channel's record is lost.
        ended: The file has its proper end.
        data_ended: The part with the messages has its proper end.
        damaged: Records that are there but cannot be read.
    """

    metadata: dict[str, dict[str, str]]
    entries: tuple[tuple[str, Message], ...]
    ended: bool
    data_ended: bool
    damaged: int


def salvage(data: bytes) -> Salvage:
    """Take an MCAP file apart, whatever state it is in.

    Raises: NotMcapError: it does not begin like one.
    """
    start = data[: len(MCAP0_MAGIC)]
    if not MCAP0_MAGIC.startswith(start):
        raise NotMcapError(f"not an MCAP file, it starts with {start!r}")
    metadata: dict[str, dict[str, str]] = {}
    topics: dict[int, str] = {}
    messages: list[Message] = []
    opcodes: set[int] = set()
    damaged = 0
    for opcode, body in frames(data, len(MCAP0_MAGIC)):
        opcodes.add(opcode)
        try:
            records = records_of(opcode, body)
        except DAMAGE:
            damaged += 1
            continue
        for record in records:
            match record:
                case Metadata():
                    metadata[record.name] = record.metadata
                case Channel():
                    topics.setdefault(record.id, record.topic)
                case Message():
                    messages.append(record)
    return Salvage(
        metadata=metadata,
        # Topics are looked up at the end: channels are repeated there, for when their chunk is damaged.
        entries=tuple((topics.get(message.channel_id, ""), message) for message in messages),
        ended=Opcode.FOOTER in opcodes and data.endswith(MCAP0_MAGIC),
        data_ended=Opcode.DATA_END in opcodes,
        damaged=damaged,
    )


def frames(data: bytes, at: int) -> Iterator[tuple[int, bytes]]:
    """The whole records from an offset on, as opcode and content."""
    while at + _FRAME.size <= len(data):
        opcode, length = _FRAME.unpack_from(data, at)
        at += _FRAME.size
        # Opcode 0 is none: file systems leave zeros at the end of what they did not finish.
        if opcode == 0 or length > len(data) - at:
            return
        yield opcode, data[at : at + length]
        at += length


def records_of(opcode: int, body: bytes) -> list[McapRecord]:
    """What a record says: those inside a chunk, itself, or nothing for one that is of no interest here.

    Raises: one of `DAMAGE`: it cannot be read.
    """
    stream = ReadDataStream(BytesIO(body))
    if opcode == Opcode.CHUNK:
        return breakup_chunk(Chunk.read(stream), validate_crc=True)
    if opcode == Opcode.METADATA:
        return [Metadata.read(stream)]
    if opcode == Opcode.CHANNEL:
        return [Channel.read(stream)]
    if opcode == Opcode.MESSAGE:  # other programs write them outside chunks
        return [Message.read(stream, len(body))]
    return []
