"""Parser of MCAP files that may be cut, damaged or still being written, where the mcap package would stop or err."""

import struct
from collections.abc import Iterator
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
        self.damaged = (
            0  # records that cannot be decoded, and messages of a channel that is not known
        )

    def entries(self) -> Iterator[tuple[Channel, Message]]:
        """Yield the messages of the whole chunks not read yet, in order.

        Raises: OSError. McapError: no MCAP file.
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
                    found = self._read(opcode, ReadDataStream(BytesIO(body)))
                except Exception:  # noqa: BLE001  # whatever damaged bytes lead to
                    self.damaged += 1
                    continue
                self._channels |= {
                    record.id: record for record in found if isinstance(record, Channel)
                }
                for record in (record for record in found if isinstance(record, Message)):
                    if (
                        record.channel_id not in self._channels
                    ):  # its record is in a damaged chunk, and in the summary
                        self._channels |= getattr(self._summary(), "channels", {})
                    if record.channel_id in self._channels:
                        yield self._channels[record.channel_id], record
                    else:
                        self.damaged += 1

    def is_whole(self) -> bool:
        """Return whether the file has its proper end, behind index and summary."""
        return self.ended and self._summary() is not None

    def _read(self, opcode: int, stream: ReadDataStream) -> list[Any]:
        """Return the records in a chunk; take note of metadata."""
        if opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            self.metadata.setdefault(metadata.name, metadata.metadata)
        return (
            breakup_chunk(Chunk.read(stream), validate_crc=True) if opcode == Opcode.CHUNK else []
        )

    def _summary(self) -> Any:
        """Return the summary of a file with a proper end; otherwise None."""
        try:
            with self._path.open("rb") as file:
                return make_reader(file).get_summary()
        except Exception:  # noqa: BLE001  # no end, or a damaged one
            return None


def records(file: BinaryIO, offset: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield opcode, offset of the body and body of the whole records from an offset on."""
    size = file.seek(0, SEEK_END)
    while offset + _RECORD.size <= size:
        file.seek(offset)
        opcode, length = _RECORD.unpack(file.read(_RECORD.size))
        offset += _RECORD.size
        if (
            opcode == 0 or length > size - offset
        ):  # file systems leave zeros behind an unfinished file
            return
        yield opcode, offset, file.read(length)
        offset += length
