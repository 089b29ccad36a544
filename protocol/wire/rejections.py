"""Refused messages of one process: counted by sender and reason, with one example of each, and reported."""

from collections.abc import Iterator
from dataclasses import dataclass

from protocol.wire.message import MAX_TEXT, MessageError, Reason
from protocol.wire.messages import Rejected

# Senders counted separately. A message can claim any sender, so the rest share a name.
MAX_SENDERS = 64
OTHERS = "others"

# A sender is a process name, or else a key, which can be of any length.
_LONGEST_SENDER = 80

# Between two batches of `Rejected` messages.
_EVERY_NS = 1_000_000_000


@dataclass(slots=True)
class Rejection:
    """Messages of one sender refused for one reason."""

    sender: str  # according to the messages, or the end of their key where that cannot be read
    reason: Reason
    example: str  # error of the first of them
    count: int = 0
    reported: int = 0  # in `Rejected` messages


class Rejections:
    """Counts of one process, in bounded memory.

    Attributes:
        total: Messages refused so far.
    """

    def __init__(self, name: str) -> None:
        self.total = 0
        self._name = name
        self._entries: dict[tuple[str, Reason], Rejection] = {}
        self._senders: set[str] = set()
        self._sent = 0  # `Rejected` messages
        self._next_ns = 0

    def __iter__(self) -> Iterator[Rejection]:
        """Yield the refusals so far, in the order they first happened."""
        return iter(self._entries.values())

    def add(self, sender: str, error: MessageError) -> None:
        """Count a message of a sender, or under a key."""
        sender = sender[:_LONGEST_SENDER]
        if sender not in self._senders and len(self._senders) >= MAX_SENDERS:
            sender = OTHERS
        self._senders.add(sender)
        at = sender, error.reason
        if at not in self._entries:
            self._entries[at] = Rejection(sender, error.reason, str(error)[:MAX_TEXT])
        self._entries[at].count += 1
        self.total += 1

    def due(self, now_ns: int, incarnation: int, tick: int) -> list[Rejected]:
        """Return the messages to send now, by a monotonic clock: at most one batch a second, none without news."""
        if now_ns < self._next_ns or self.total == sum(entry.reported for entry in self):
            return []
        self._next_ns = now_ns + _EVERY_NS
        return self.rest(incarnation, tick)

    def rest(self, incarnation: int, tick: int) -> list[Rejected]:
        """Return all messages not sent yet, at the end of a run; the tick is the newest one the process knows."""
        messages = []
        for entry in self:
            if entry.count == entry.reported:
                continue
            messages.append(
                Rejected(
                    sender=self._name,
                    incarnation=incarnation,
                    sequence=self._sent,
                    tick=tick,
                    offender=entry.sender,
                    reason=entry.reason,
                    count=entry.count - entry.reported,
                    example=entry.example,
                )
            )
            entry.reported = entry.count
            self._sent += 1
        return messages
