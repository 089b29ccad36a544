"""Parser of MCAP files in any state: whole, cut, damaged, or still being written.

The reader of the mcap package stops at the first problem and takes a cut record for a shorter one. Here a record counts
only if all its bytes are there, and a chunk only if its checksum is right.
"""

import struct
from collections.abc import Iterable, Iterator
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

_RECORD = struct.Struct("<BQ")  # opcode, length of the body


class Parser:
    """Parser of one file, which may grow between two calls of `entries`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = len(MCAP0_MAGIC)  # of the next record
        self._channels: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}  # by name
        self.ended = False  # whether the data section has come to its proper end
        self.damaged = 0  # records that cannot be decoded, and messages of a channel that is not known

    def entries(self) -> Iterator[tuple[Channel, Message]]:
        """Yield the messages of the chunks that are whole and were not read yet, in the order of the file.

        Raises: OSError: the file cannot be read. McapError: it is no MCAP file.
        """
        with self._path.open("rb") as file:
            start = file.read(len(MCAP0_MAGIC))
            if not MCAP0_MAGIC.startswith(start):
                raise McapError(f"not an MCAP file, it starts with {start!r}")
            for opcode, offset, body in records(file, self._offset):
                if self.ended:
                    return
                self._offset, self.ended = offset + len(body), opcode == Opcode.DATA_END
                try:
                    found = self._read(opcode, body)
                except Exception:  # noqa: BLE001  # whatever damaged bytes lead to
                    self.damaged += 1
                    continue
                yield from self._messages(found)

    def is_whole(self) -> bool:
        """Return whether the file has its proper end, behind index and summary."""
        return self.ended and self._summary() is not None

    def _read(self, opcode: int, body: bytes) -> Iterable[Any]:
        """Return the records in a chunk; take note of metadata."""
        stream = ReadDataStream(BytesIO(body))
        if opcode == Opcode.CHUNK:
            return breakup_chunk(Chunk.read(stream), validate_crc=True)
        if opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            self.metadata.setdefault(metadata.name, metadata.metadata)
        return ()

    def _messages(self, found: Iterable[Any]) -> Iterator[tuple[Channel, Message]]:
        for record in found:
            if isinstance(record, Channel):
                self._channels.setdefault(record.id, record)
            elif isinstance(record, Message):
                if record.channel_id not in self._channels:  # its record is in a damaged chunk, and in the summary
                    self._channels |= getattr(self._summary(), "channels", {})
                if record.channel_id in self._channels:
                    yield self._channels[record.channel_id], record
                else:
                    self.damaged += 1

    def _summary(self) -> Any:
        """Return the summary of a file with a proper end; otherwise None."""
        try:
            with self._path.open("rb") as file:
                return make_reader(file).get_summary()
        except Exception:  # noqa: BLE001  # no end, or a damaged one
            return None


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
