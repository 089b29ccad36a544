"""Refused messages of one process: counted by sender and reason, with one example of each, and reported."""

from collections.abc import Iterator
from dataclasses import dataclass

from protocol.wire.message import MAX_KEY, MAX_TEXT, MessageError, Reason
from protocol.wire.messages import Rejected

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
    """Counts of one process, which iteration yields in the order they began; `total` is their sum."""

    def __init__(self, name: str) -> None:
        self.total = 0
        self._name = name
        self._entries: dict[tuple[str, Reason], Rejection] = {}
        self._sent = 0  # `Rejected` messages
        self._next_ns = 0

    def __iter__(self) -> Iterator[Rejection]:
        return iter(self._entries.values())

    def add(self, sender: str, error: MessageError) -> None:
        """Count a message of a sender, or under a key."""
        new = Rejection(sender[:MAX_KEY], error.reason, str(error)[:MAX_TEXT])
        self._entries.setdefault((new.sender, new.reason), new).count += 1
        self.total += 1

    def due(self, now_ns: int, incarnation: int, tick: int) -> list[Rejected]:
        """Return the messages to send now, by a monotonic clock: at most one batch a second, none without news."""
        if now_ns < self._next_ns or self.total == sum(entry.reported for entry in self):
            return []
        self._next_ns = now_ns + _EVERY_NS
        return self.rest(incarnation, tick)

    def rest(self, incarnation: int, tick: int) -> list[Rejected]:
        """Return all messages not sent yet, at the end of a run; the tick is the newest one the process knows."""
        news = [entry for entry in self if entry.count > entry.reported]
        messages = [
            Rejected(
                sender=self._name,
                incarnation=incarnation,
                sequence=number,
                tick=tick,
                offender=entry.sender,
                reason=entry.reason,
                count=entry.count - entry.reported,
                example=entry.example,
            )
            for number, entry in enumerate(news, start=self._sent)
        ]
        self._sent += len(messages)
        for entry in news:
            entry.reported = entry.count
        return messages
