"""A chunk of an MCAP file in the making, packed by hand: this is what recording a message costs.

The records of the mcap package would say the same bytes at several times the price (https://mcap.dev/spec).
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import zstandard
from mcap.opcode import Opcode

# Every record begins with its opcode and its length. Little-endian, without the variable part behind it:
_MESSAGE = struct.Struct("<BQHIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<BQQQQII4sQ")  # first and last time, size, checksum, compression, compressed size
_MESSAGE_INDEX = struct.Struct("<BQHI")  # channel, length of the entries
_ENTRY = struct.Struct("<QQ")  # log time, place in the chunk
_CHUNK_INDEX = struct.Struct("<BQQQQQI")  # first and last time, place, length, length of the offsets
_OFFSET = struct.Struct("<HQ")  # channel, place of its index
_CHUNK_INDEX_END = struct.Struct("<QI4sQQ")  # length of the indexes, compression, compressed size, size
_FRAME_BYTES = 9  # opcode and length

_COMPRESSION = b"zstd"
_LATEST = 2**64 - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Packed:
    """A finished chunk.

    Attributes:
        records: The chunk and the message indexes behind it.
        index: The chunk index, for the summary.
    """

    records: bytes
    index: bytes


class Chunk:
    """Messages, and what has to be known before them, until they are compressed.

    Attributes:
        first_time: Least log time, ns.
        last_time: Largest log time, ns.
    """

    def __init__(self) -> None:
        self.first_time, self.last_time = _LATEST, 0
        self._data = bytearray()
        self._entries: dict[int, bytearray] = defaultdict(bytearray)  # of the message indexes, by channel

    def __len__(self) -> int:
        """Bytes before compression."""
        return len(self._data)

    @property
    def has_messages(self) -> bool:
        """Whether there is one."""
        return bool(self._entries)

    def counts(self) -> Iterator[tuple[int, int]]:
        """Channels and how many messages each has here."""
        return ((channel, len(entries) // _ENTRY.size) for channel, entries in self._entries.items())

    def add(self, record: bytes) -> None:
        """Add a whole record: a schema or a channel."""
        self._data += record

    def message(self, channel: int, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        """Add a message; times in ns, the sequence number less than 2^32."""
        self._entries[channel] += _ENTRY.pack(log_time, len(self._data))
        length = _MESSAGE.size - _FRAME_BYTES + len(data)
        self._data += _MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence, log_time, publish_time)
        self._data += data
        if log_time < self.first_time:
            self.first_time = log_time
        if log_time > self.last_time:
            self.last_time = log_time

    def packed(self, compressor: zstandard.ZstdCompressor, place: int) -> Packed:
        """The chunk as it is written.

        Args:
            compressor: Used for this alone at the time.
            place: Offset in the file at which it will be.
        """
        data, size, times = compressor.compress(self._data), len(self._data), (self.first_time, self.last_time)
        length = _CHUNK.size - _FRAME_BYTES + len(data)
        checksum, compression = zlib.crc32(self._data), (len(_COMPRESSION), _COMPRESSION)
        parts: list[bytes | bytearray] = [
            _CHUNK.pack(Opcode.CHUNK, length, *times, size, checksum, *compression, len(data)),
            data,
        ]
        indexes = at = place + _FRAME_BYTES + length
        offsets = bytearray()
        for channel, entries in self._entries.items():
            offsets += _OFFSET.pack(channel, at)
            length = _MESSAGE_INDEX.size - _FRAME_BYTES + len(entries)
            parts += [_MESSAGE_INDEX.pack(Opcode.MESSAGE_INDEX, length, channel, len(entries)), entries]
            at += _FRAME_BYTES + length
        length = _CHUNK_INDEX.size - _FRAME_BYTES + len(offsets) + _CHUNK_INDEX_END.size
        index: list[bytes | bytearray] = [
            _CHUNK_INDEX.pack(Opcode.CHUNK_INDEX, length, *times, place, indexes - place, len(offsets)),
            offsets,
            _CHUNK_INDEX_END.pack(at - indexes, *compression, len(data), size),
        ]
        return Packed(records=b"".join(parts), index=b"".join(index))
