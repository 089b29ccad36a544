"""Messages that a process sends: numbered in their order, as its end without the coordinator."""

from typing import Any, TypeVar

import msgspec
import numpy as np

from transport.protocol.wire.errors_and_exit_codes import EXIT_UNREACHABLE
from transport.protocol.wire.messages import Control, Message

M = TypeVar("M", bound=Message)


class Outbox:
    """Source of a process's messages; their sequence number grows by one."""

    def __init__(self, sender: str, incarnation: int) -> None:
        self.sender = sender
        self.incarnation = incarnation
        self._sequence = 0

    def stamp(self, kind: type[M], **fields: Any) -> M:
        """Return a message of this sender with the next sequence number.

        Its arrays are read-only copies.
        """
        for field in kind.shapes:
            if field in fields:
                values = np.array(fields[field], dtype=np.float64)
                values.setflags(write=False)
                fields[field] = values
        message = kind(
            sender=self.sender, incarnation=self.incarnation, sequence=self._sequence, **fields
        )
        self._sequence += 1
        return message

    def again(self, message: M) -> M:
        """Return a message sent before, under a new number, for processes that joined since."""
        self._sequence += 1
        return msgspec.structs.replace(message, sequence=self._sequence - 1)


def end_without_coordinator(outbox: Outbox, tick: int, reason: str) -> Control:
    """Return the end of a run for a node that has lost the coordinator, which would send it."""
    return outbox.stamp(
        Control, tick=max(tick, 0), outcome="aborted", reason=reason, exit_code=EXIT_UNREACHABLE
    )
