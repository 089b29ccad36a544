"""Numbering of a process's own messages."""

from dataclasses import replace
from typing import Any, TypeVar

from protocol.wire.exit_codes import EXIT_UNREACHABLE
from protocol.wire.messages import Control, Message

M = TypeVar("M", bound=Message)


class Outbox:
    """Source of a process's messages, with sender, incarnation and a sequence number that grows by one."""

    def __init__(self, sender: str, incarnation: int) -> None:
        self.sender, self.incarnation = sender, incarnation
        self._sequence = 0

    def stamp(self, kind: type[M], **fields: Any) -> M:
        """Return a message of this sender with the next sequence number."""
        message = kind(sender=self.sender, incarnation=self.incarnation, sequence=self._sequence, **fields)
        self._sequence += 1
        return message

    def again(self, message: M) -> M:
        """Return a message that was sent before, under a new sequence number, for processes that joined since."""
        self._sequence += 1
        return replace(message, sequence=self._sequence - 1)


def lost(outbox: Outbox, tick: int, reason: str) -> Control:
    """Return the end of a run for a node that has lost the coordinator, and with it the sender of that message."""
    return outbox.stamp(Control, tick=max(tick, 0), outcome="aborted", reason=reason, exit_code=EXIT_UNREACHABLE)
