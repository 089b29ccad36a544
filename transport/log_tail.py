"""A log read while it is written: what has been added since the last look.

This is how people watch a run without taking part in it: neither its processes nor its recorder know of them.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel
from mcap.records import Message as Entry
from mcap.writer import MCAP0_MAGIC

from protocol.messages import KINDS, Message
from transport.json_messages import from_json
from transport.log import LogError
from transport.mcap_salvage import DAMAGE, frames, records_of

_FRAME_BYTES = 9  # opcode and length

# How a plan or report begins, up to what it is looked up by; negotiation is a plan's alone.
_HEAD = re.compile(rb'"tick":(\d+),"agent":(\d+),(?:"start_tick":\d+,"negotiation":(\d+),)?')
_HEAD_BYTES = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class Unread:
    """A message that is taken apart when somebody asks for it.

    Attributes:
        kind: Key of `protocol.messages.KINDS`.
        tick: k.
        agent: 1-based.
        negotiation: Round of a plan; 0 for other messages.
        data: JSON.
    """

    kind: str
    tick: int
    agent: int
    negotiation: int
    data: bytes

    def message(self) -> Message | None:
        """What it says; None if it is damaged."""
        try:
            return from_json(self.kind, self.data)
        except (ValueError, TypeError):
            return None


class LogTail:
    """Follows one log.

    Args:
        path: Of the file, which need not be there yet.
        kinds: Of messages that are wanted: what nobody asks for is not taken apart.
        later: Those of them that are left as they are until they are asked for, which is most of the work.

    Attributes:
        ended: Whether the part with the messages has come to its proper end.
    """

    def __init__(self, path: Path, kinds: Collection[str] = KINDS, later: Collection[str] = ()) -> None:
        self._path, self._wanted, self._later = path, frozenset(kinds), frozenset(later)
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
            self._at += _FRAME_BYTES + len(body)
            self.ended = opcode == Opcode.DATA_END
            found += self._messages(opcode, body)
        return found

    def _messages(self, opcode: int, body: bytes) -> list[Message | Unread]:
        found: list[Message | Unread] = []
        try:
            for record in records_of(opcode, body):
                if isinstance(record, Channel):
                    self._kinds[record.id] = record.topic.lstrip("/").split("/", 1)[0]
                elif isinstance(record, Entry) and self._kinds.get(record.channel_id) in self._wanted:
                    found.append(self._taken(self._kinds[record.channel_id], record.data))
        except (*DAMAGE, TypeError):
            return found  # `read_log` says what a damaged log lacks
        return found

    def _taken(self, kind: str, data: bytes) -> Message | Unread:
        head = _HEAD.search(data, 0, _HEAD_BYTES) if kind in self._later else None
        if head is None:
            return from_json(kind, data)
        tick, agent, negotiation = (int(number or 0) for number in head.groups())
        return Unread(kind=kind, tick=tick, agent=agent, negotiation=negotiation, data=data)
