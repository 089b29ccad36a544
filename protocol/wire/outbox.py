"""Numbering of a process's own messages."""

from dataclasses import replace
from typing import Any, TypeVar

from protocol.wire.exit_codes import EXIT_UNREACHABLE
from protocol.wire.messages import Control, Message

M = TypeVar("M", bound=Message)


class Outbox:
    """Stamps messages with sender, incarnation and a sequence number that grows by one.

    Args:
        sender: Process name.
        incarnation: Which start of it.
    """

    def __init__(self, sender: str, incarnation: int) -> None:
        self.sender, self.incarnation = sender, incarnation
        self._sequence = 0

    def stamp(self, kind: type[M], **fields: Any) -> M:
        """A message of this sender with the next sequence number."""
        message = kind(sender=self.sender, incarnation=self.incarnation, sequence=self._sequence, **fields)
        self._sequence += 1
        return message

    def again(self, message: M) -> M:
        """A message that was sent before, for those who were not there, with a number of its own."""
        again = replace(message, sequence=self._sequence)
        self._sequence += 1
        return again


def lost(outbox: Outbox, tick: int, reason: str) -> Control:
    """The end of a run as a node sees it that has lost the coordinator: nobody else will tell it."""
    return outbox.stamp(Control, tick=max(tick, 0), outcome="aborted", reason=reason, exit_code=EXIT_UNREACHABLE)
