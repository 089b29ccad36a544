"""Refused messages, counted by sender and reason, with one example of each."""

from collections.abc import Iterator
from dataclasses import dataclass

from protocol.wire.messages import MAX_TEXT, MessageError, Reason, Rejected

# Senders counted separately. A message can claim any sender, so the rest share a name.
MAX_SENDERS = 64
OTHERS = "others"

# A sender is a process name, or else a key, which can be of any length.
_LONGEST_SENDER = 80

# Between two `Rejected` messages.
_EVERY_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Rejection:
    """Messages of one sender refused for one reason."""

    sender: str  # according to the messages, or the end of their key where that cannot be read
    reason: Reason
    count: int
    example: str  # error of the first of them


class Rejections:
    """Counts of one process, in bounded memory.

    Attributes:
        total: Messages refused so far.
    """

    def __init__(self) -> None:
        self.total = 0
        self._counts: dict[tuple[str, Reason], int] = {}
        self._examples: dict[tuple[str, Reason], str] = {}
        self._senders: set[str] = set()
        self._reported: dict[tuple[str, Reason], int] = {}

    def __iter__(self) -> Iterator[Rejection]:
        """Yield the refusals so far, in the order they first happened."""
        for (sender, reason), count in self._counts.items():
            yield Rejection(sender, reason, count, self._examples[sender, reason])

    def add(self, sender: str, error: MessageError, count: int = 1) -> None:
        """Count messages of a sender, or under a key, by the error of the first of them."""
        sender = sender[:_LONGEST_SENDER]
        if sender not in self._senders:
            if len(self._senders) < MAX_SENDERS:
                self._senders.add(sender)
            else:
                sender = OTHERS
        at = sender, error.reason
        if at not in self._counts:
            self._counts[at] = 0
            self._examples[at] = str(error)[:MAX_TEXT]
        self._counts[at] += count
        self.total += count

    def news(self) -> Iterator[Rejection]:
        """Yield the refusals since the last call, with their counts since then."""
        reported, self._reported = self._reported, dict(self._counts)
        for (sender, reason), count in self._reported.items():
            new = count - reported.get((sender, reason), 0)
            if new:
                yield Rejection(sender, reason, new, self._examples[sender, reason])


class Notices:
    """`Rejected` messages of a process: none without news, and at most one batch a second."""

    def __init__(self, name: str, rejections: Rejections) -> None:
        self._name, self._rejections = name, rejections
        self._reported = 0
        self._sent = 0
        self._next_ns: int | None = None

    def due(self, now_ns: int, incarnation: int, tick: int) -> list[Rejected]:
        """Return the messages to send now, by a monotonic clock; the tick is the newest one the process knows."""
        if self._rejections.total == self._reported or (self._next_ns is not None and now_ns < self._next_ns):
            return []
        self._next_ns = now_ns + _EVERY_NS
        return self.rest(incarnation, tick)

    def rest(self, incarnation: int, tick: int) -> list[Rejected]:
        """Return all messages not sent yet, at the end of a run."""
        self._reported = self._rejections.total
        messages = [
            Rejected(
                sender=self._name,
                incarnation=incarnation,
                sequence=sequence,
                tick=tick,
                offender=entry.sender,
                reason=entry.reason,
                count=entry.count,
                example=entry.example,
            )
            for sequence, entry in enumerate(self._rejections.news(), start=self._sent)
        ]
        self._sent += len(messages)
        return messages
