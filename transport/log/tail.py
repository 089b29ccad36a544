"""A log read while it is written, by readers that take no part in the run."""

import re
from collections import OrderedDict
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel
from mcap.writer import MCAP0_MAGIC

from protocol.wire.messages import KINDS, Message
from transport.log.json_messages import from_json
from transport.log.run_log import LogError, kind_of
from transport.log.salvage import DAMAGE, MESSAGE_HEADER, chunk_content, frames, records

# The JSON of a plan or report begins with the fields it is looked up by; only plans have a negotiation.
_LOOKUP_FIELDS = re.compile(rb'"tick":(\d+),"agent":(\d+),(?:"start_tick":\d+,"negotiation":(\d+),)?')
_LOOKUP_BYTES = 200

# Decompressed chunks kept in memory: messages that are looked up together lie close together.
_CACHED_CHUNKS = 8


class Chunks:
    """Decompressed chunks of one log file, read on demand."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._cache: OrderedDict[tuple[int, int], bytes] = OrderedDict()

    def content(self, offset: int, size: int) -> bytes | None:
        """Return the content of the chunk whose body lies at an offset, bytes; None if it cannot be read any more."""
        data = self._cache.pop((offset, size), None)
        if data is None:
            try:
                with self._path.open("rb") as file:
                    file.seek(offset)
                    data = chunk_content(file.read(size))
            except (OSError, *DAMAGE):
                return None
        self._cache[offset, size] = data
        if len(self._cache) > _CACHED_CHUNKS:
            self._cache.popitem(last=False)
        return data


@dataclass(frozen=True, slots=True, kw_only=True)
class Unread:
    """A message that stays in the file until it is needed.

    Attributes:
        kind: Key of `protocol.wire.messages.KINDS`.
        tick: k.
        agent: 1-based.
        negotiation: Iterations still to come, for a plan; 0 for other messages.
        chunks: Chunks of its log.
        chunk: Offset and size of its chunk, bytes.
        span: Where it begins and ends in the content of the chunk, bytes.
    """

    kind: str
    tick: int
    agent: int
    negotiation: int
    chunks: Chunks
    chunk: tuple[int, int]
    span: tuple[int, int]

    def message(self) -> Message | None:
        """Return the message; None if it is damaged, or the file is gone or replaced."""
        data = self.chunks.content(*self.chunk)
        if data is None:
            return None
        try:
            message = from_json(self.kind, data[slice(*self.span)])
        except (ValueError, TypeError):
            return None
        return message if message.tick == self.tick else None


class LogTail:
    """Reader that follows one log.

    Args:
        path: The file, which need not exist yet.
        kinds: Kinds of messages to read; others are skipped without decoding.
        later: Those of them that are left in the file as `Unread`, which saves most of the memory.

    Attributes:
        ended: Whether the data section has come to its proper end.
    """

    def __init__(self, path: Path, kinds: Collection[str] = KINDS, later: Collection[str] = ()) -> None:
        self._path, self._wanted, self._later = path, frozenset(kinds), frozenset(later)
        self._chunks = Chunks(path)
        self._offset = len(MCAP0_MAGIC)  # of the next record
        self._kinds: dict[int, str] = {}  # by channel
        self.ended = False

    def read(self) -> list[Message | Unread]:
        """Return the new messages, in order; a record written only in part waits for the next call.

        Damage is skipped silently: `read_log` reports it.

        Raises: LogError: the file cannot be read.
        """
        found: list[Message | Unread] = []
        if self.ended:
            return found
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                for opcode, offset, body in frames(file):
                    self._offset = offset + len(body)
                    with suppress(*DAMAGE):
                        self._read_record(opcode, offset, body, found)
                    if opcode == Opcode.DATA_END:
                        self.ended = True
                        break
        except FileNotFoundError:
            pass
        except OSError as error:
            raise LogError(f"{self._path}: cannot read the log ({error.strerror or error})") from error
        return found

    def _read_record(self, opcode: int, offset: int, body: bytes, found: list[Message | Unread]) -> None:
        """Append the messages in a record of the file.

        Raises: one of `DAMAGE`: it cannot be decoded.
        """
        for code, data, begin, end in records(opcode, body):
            if code == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(data[begin:end])))
                self._kinds[channel.id] = kind_of(channel.topic)
            elif code == Opcode.MESSAGE:
                number = MESSAGE_HEADER.unpack(data[begin : min(begin + MESSAGE_HEADER.size, end)])[0]
                kind = self._kinds.get(number, "")
                begin += MESSAGE_HEADER.size
                if kind not in self._wanted:
                    continue
                lookup = None
                if opcode == Opcode.CHUNK and kind in self._later:
                    lookup = _LOOKUP_FIELDS.search(data, begin, min(begin + _LOOKUP_BYTES, end))
                if lookup is None:
                    with suppress(ValueError, TypeError):
                        found.append(from_json(kind, data[begin:end]))
                    continue
                tick, agent, negotiation = (int(number or 0) for number in lookup.groups())
                found.append(
                    Unread(
                        kind=kind,
                        tick=tick,
                        agent=agent,
                        negotiation=negotiation,
                        chunks=self._chunks,
                        chunk=(offset, len(body)),
                        span=(begin, end),
                    )
                )
