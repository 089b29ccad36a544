"""The log of an active run, read while it grows."""

from pathlib import Path
from typing import TypeVar

from transport.log.run_log import LogTail
from transport.protocol.wire.messages import FaultNote, Message

M = TypeVar("M", bound=Message)


class LiveLog:
    """Log of an active run: each question is answered from all messages recorded until then."""

    def __init__(self, path: Path) -> None:
        self._tail = LogTail(path)
        self._messages: list[Message] = []

    def of(self, kind: type[M]) -> list[M]:
        """Return the messages of one kind so far, in order; of all kinds with `Message`."""
        self._messages += self._tail.read()
        return [message for message in self._messages if isinstance(message, kind)]

    def has_fault_by_hand(self, target: str, what: str) -> bool:
        """Return whether a fault of a process that a person requested is recorded, such as "killed"."""
        return any(
            (note.target, note.what, note.origin) == (target, what, "person")
            for note in self.of(FaultNote)
        )
