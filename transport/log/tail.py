"""A log read while it is written: what has been added since the last look.

This is how people watch a run without taking part in it: neither its processes nor its recorder know of them.
"""

import re
from collections import OrderedDict
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel
from mcap.writer import MCAP0_MAGIC

from protocol.wire.messages import KINDS, Message
from transport.log.json_messages import from_json
from transport.log.run_log import LogError
from transport.log.salvage import DAMAGE, MESSAGE_HEAD, content_of, contents, frames, records_of

_FRAME_BYTES = 9  # opcode and length

# How a plan or report begins, up to what it is looked up by; negotiation is a plan's alone.
_HEAD = re.compile(rb'"tick":(\d+),"agent":(\d+),(?:"start_tick":\d+,"negotiation":(\d+),)?')
_HEAD_BYTES = 200


# What is looked back at lies close together: contents of so many chunks are kept.
_CHUNKS = 8


class Chunks:
    """What is packed in the chunks of a log, taken from the file when somebody asks for it.

    Args:
        path: Of the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._kept: OrderedDict[tuple[int, int], bytes] = OrderedDict()

    def content(self, at: int, size: int) -> bytes | None:
        """What is packed in one; None if it cannot be read any more.

        Args:
            at: Where the body of its record is in the file, bytes.
            size: Of that, bytes.
        """
        if (at, size) in self._kept:
            self._kept.move_to_end((at, size))
            return self._kept[at, size]
        try:
            with self._path.open("rb") as file:
                file.seek(at)
                data = content_of(file.read(size))
        except (OSError, *DAMAGE):
            return None
        self._kept[at, size] = data
        if len(self._kept) > _CHUNKS:
            self._kept.popitem(last=False)
        return data


@dataclass(frozen=True, slots=True, kw_only=True)
class Unread:
    """A message that stays in the file until somebody asks for it.

    Attributes:
        kind: Key of `protocol.wire.messages.KINDS`.
        tick: k.
        agent: 1-based.
        negotiation: Round of a plan; 0 for other messages.
        chunks: Of the log it is in.
        chunk: Offset and size of its chunk, bytes.
        inside: From where to where it is in the chunk's content, bytes.
    """

    kind: str
    tick: int
    agent: int
    negotiation: int
    chunks: Chunks
    chunk: tuple[int, int]
    inside: tuple[int, int]

    def message(self) -> Message | None:
        """What it says; None if it is damaged, or gone with its file."""
        data = self.chunks.content(*self.chunk)
        if data is None:
            return None
        try:
            message = from_json(self.kind, data[slice(*self.inside)])
        except (ValueError, TypeError):
            return None
        return message if message.tick == self.tick else None  # else it is another file by now


class LogTail:
    """Follows one log.

    Args:
        path: Of the file, which need not be there yet.
        kinds: Of messages that are wanted: what nobody asks for is not taken apart.
        later: Those of them that are left in their chunks until they are asked for, which is most of a log.

    Attributes:
        ended: Whether the part with the messages has come to its proper end.
    """

    def __init__(self, path: Path, kinds: Collection[str] = KINDS, later: Collection[str] = ()) -> None:
        self._path, self._wanted, self._later = path, frozenset(kinds), frozenset(later)
        self._chunks = Chunks(path)
        self._at = len(MCAP0_MAGIC)
        self._kinds: dict[int, str] = {}  # by channel
        self.ended = False

    def read(self) -> list[Message | Unread]:
        """The messages wanted that have come since, in order; what is written only in part waits for the next time.

        Raises: LogError: the file cannot be read.
        """
        try:
            with self._path.open("rb") as file:
                file.seek(self._at)
                data = file.read()
        except FileNotFoundError:
            return []
        except OSError as error:
            raise LogError(f"{self._path}: cannot read the log ({error.strerror or error})") from error
        found: list[Message | Unread] = []
        for opcode, body in frames(data, 0):
            if self.ended:
                break
            where = (self._at + _FRAME_BYTES, len(body))
            self._at = sum(where)
            self.ended = opcode == Opcode.DATA_END
            try:
                if opcode == Opcode.CHUNK:
                    content = content_of(body)
                    for code, begin, end in contents(content):
                        self._take(code, content, (begin, end), where, found)
                else:
                    self._take(opcode, body, (0, len(body)), None, found)
            except DAMAGE:
                continue  # `read_log` says what a damaged log lacks
        return found

    def _take(
        self,
        opcode: int,
        data: bytes,
        inside: tuple[int, int],
        chunk: tuple[int, int] | None,
        found: list[Message | Unread],
    ) -> None:
        """Take in one record.

        Args:
            opcode: Of the record.
            data: What it is in: a chunk's content, or its body alone.
            inside: From where to where its body is in that, bytes.
            chunk: Offset and size of its chunk in the file, bytes; None for a record outside of chunks.
            found: Where messages are put that are wanted.
        Raises: one of `DAMAGE`: it cannot be read.
        """
        begin, end = inside
        if opcode == Opcode.CHANNEL:
            for record in records_of(opcode, data[begin:end]):
                if isinstance(record, Channel):
                    self._kinds[record.id] = record.topic.lstrip("/").split("/", 1)[0]
        if opcode != Opcode.MESSAGE:
            return
        kind = self._kinds.get(MESSAGE_HEAD.unpack(data[begin : min(begin + MESSAGE_HEAD.size, end)])[0])
        if kind is None or kind not in self._wanted:
            return
        said = begin + MESSAGE_HEAD.size
        head = None
        if chunk is not None and kind in self._later:
            head = _HEAD.search(data, said, min(said + _HEAD_BYTES, end))
        if chunk is not None and head is not None:
            tick, agent, negotiation = (int(number or 0) for number in head.groups())
            found.append(
                Unread(
                    kind=kind,
                    tick=tick,
                    agent=agent,
                    negotiation=negotiation,
                    chunks=self._chunks,
                    chunk=chunk,
                    inside=(said, end),
                )
            )
            return
        with suppress(ValueError, TypeError):
            found.append(from_json(kind, data[said:end]))
