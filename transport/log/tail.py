"""A log read while it is written, by readers that take no part in the run."""

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from protocol.scenario.setup import Setup
from protocol.wire.codec import decode
from protocol.wire.messages import KINDS, Message, MessageError, Plan, StepReport
from transport.log.channels import METADATA, is_known
from transport.log.parser import DAMAGE, Found, Parser, Place, content_of
from transport.log.run_log import LogReception, Read, reading, setup_in

# Decompressed chunks kept in memory: messages that are looked up together lie close together.
chunk = lru_cache(maxsize=8)(content_of)


@dataclass(frozen=True, slots=True, kw_only=True)
class Unread:
    """A message that stays in the file until it is needed.

    Attributes:
        kind: Key of `protocol.wire.messages.KINDS`.
        tick: k.
        agent: 1-based.
        negotiation: Iterations still to come, for a plan; 0 for other messages.
        path: The log.
        chunk: Its chunk there.
        span: Where it begins and ends in the content of the chunk, bytes.
    """

    kind: str
    tick: int
    agent: int
    negotiation: int
    path: Path
    chunk: Place
    span: tuple[int, int]

    def message(self) -> Message | None:
        """Return the message; None if it is damaged, or the file is gone or replaced."""
        try:
            message = decode(chunk(self.path, self.chunk)[slice(*self.span)])
        except (MessageError, OSError, *DAMAGE):
            return None
        return message if (message.kind, message.tick) == (self.kind, self.tick) else None


class LogTail:
    """Reader that follows one log and checks its messages as `read_log` does.

    Args:
        path: The file, which need not exist yet.
        kinds: Kinds of messages to return.
        later: Those of them that are left in the file as `Unread`, which saves most of the memory.
        setup: The run, if it is known already; otherwise it is taken from the header of the log.
    """

    def __init__(
        self,
        path: Path,
        kinds: Collection[str] | Mapping[str, object] = KINDS,
        later: Collection[str] = (),
        setup: Setup | None = None,
    ) -> None:
        self._path, self._wanted, self._later = path, frozenset(kinds), frozenset(later)
        self._parser = Parser(path)
        self._setup = setup
        self._reception: LogReception | None = None

    @property
    def ended(self) -> bool:
        """Whether the data section has come to its proper end."""
        return self._parser.ended

    def read(self) -> list[Message | Unread]:
        """Return the new messages, in order; a record written only in part waits for the next call.

        Damage is skipped silently: `read_log` reports it.

        Raises: LogError: the file cannot be read.
        """
        found: list[Message | Unread] = []
        if self.ended:
            return found
        with reading(self._path), suppress(FileNotFoundError):
            for entry in self._parser.entries():
                if not is_known(entry.channel):
                    continue
                if self._reception is None:
                    header = self._parser.metadata.get(METADATA, {})
                    self._reception = LogReception(self._setup or setup_in(header, self._path.parent))
                with suppress(MessageError):
                    for read in self._reception.read(entry.channel.topic, entry.data, entry.received_ns):
                        if read[0].kind in self._wanted:
                            found.append(self._unread(read, entry) or read[0])
            if self.ended and self._reception is not None:
                found += [message for message, _ in self._reception.close()]
        return found

    def _unread(self, read: Read, entry: Found) -> Unread | None:
        """Return a message as one that stays in the file; None if it must not, or its bytes are elsewhere."""
        (message, data), place = read, entry.place
        if message.kind not in self._later or not isinstance(message, Plan | StepReport):
            return None
        if place is None or data is None:
            return None
        begin = place.begin + entry.data.find(data)
        return Unread(
            kind=message.kind,
            tick=message.tick,
            agent=message.agent,
            negotiation=message.negotiation if isinstance(message, Plan) else 0,
            path=self._path,
            chunk=place._replace(begin=0),  # one key for all messages of a chunk
            span=(begin, begin + len(data)),
        )
