"""The gate of a process or of a reader of a log.

All checks of a received message (docs/protocol.md).
"""

from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache

from transport.protocol.admission.plausibility import check_plausible
from transport.protocol.wire.codec import Header, decode, header_of
from transport.protocol.wire.errors import MessageError, Reason
from transport.protocol.wire.keys import Keys, matches
from transport.protocol.wire.messages import (
    MAX_KEY,
    MAX_TEXT,
    Bundle,
    LinkChange,
    Message,
    Plan,
    Rejected,
    Target,
)
from transport.protocol.wire.names import AGENT, COORDINATOR, MAX_UAVS, PLANT, RECORDER, agent_name
from transport.protocol.wire.node import Outbox, RunShape

_EVERY_NS = 1_000_000_000  # between two batches of `Rejected` messages


@dataclass(slots=True)
class Rejection:
    """Messages of one sender refused for one reason."""

    sender: str  # according to the messages, or the end of their key where that cannot be read
    reason: Reason
    example: str  # error of the first of them
    count: int = 0
    reported: int = 0  # in `Rejected` messages


class Rejections:
    """Counts of one process, which iteration yields in the order they began."""

    def __init__(self) -> None:
        self._entries: dict[tuple[str, Reason], Rejection] = {}

    def __iter__(self) -> Iterator[Rejection]:
        return iter(self._entries.values())

    @property
    def total(self) -> int:
        """Number of refused messages."""
        return sum(entry.count for entry in self)

    def add(self, sender: str, error: MessageError) -> None:
        """Count a message of a sender, or under a key."""
        new = Rejection(sender[:MAX_KEY], error.reason, str(error)[:MAX_TEXT])
        self._entries.setdefault((new.sender, new.reason), new).count += 1


@dataclass(frozen=True, slots=True)
class Sample:
    """Event: a message as it came, of which only the header was read."""

    key: str
    data: bytes
    header: Header


class Gate:
    """Checks of the messages that one process receives.

    Without a shape (the run is not known) agents and plausibility are not checked. `check_moment`
    refuses messages that the node cannot use, None for observers; `unread` are kinds that are
    handed over as samples.
    """

    def __init__(
        self,
        name: str,
        keys: Keys,
        shape: RunShape | None = None,
        check_moment: Callable[[Message], None] | None = None,
        unread: Collection[str] = (),
    ) -> None:
        self.rejections = Rejections()
        self._out, self._next_ns = (
            Outbox(name, 0),
            0,
        )  # notices of refusals, and the time of the next
        self.bundle: Bundle | None = None  # that the last accepted message came in
        self.tick = 0  # newest of an accepted message
        self._name, self._keys, self._shape, self._check_moment = name, keys, shape, check_moment
        self._relayed = shape is not None and shape.relayed
        agents = range(1, MAX_UAVS + 1) if shape is None else shape.owned
        self._senders = {COORDINATOR, PLANT, RECORDER, *map(agent_name, agents)}
        self._subscribed = [keys.end(key) for key in keys.subscriptions(name)]
        self._own = {keys.end(key) for key in keys.publications(name)}
        self._is_mine, self._unread = cache(self._receives), unread
        self._incarnations: dict[str, int] = {}  # newest announced, by sender
        # Place and sequence number of the newest message, by kind, end of the key and incarnation.
        # Proposals of a negotiation have an order of their own: they come alone, and may overtake
        # the plan of the tick before.
        self._newest: dict[tuple[str, object, int, bool], tuple[tuple[int, int], int]] = {}

    def accept(self, key: str, data: bytes) -> Iterator[Message | Sample]:
        """Yield the messages in some bytes that pass all checks, each to be handled before the next is asked for."""
        with suppress(MessageError):
            if self._unread and (header := header_of(data)).kind in self._unread:
                yield Sample(key, data, header)
                return
        message = self._checked(key, data)
        if not isinstance(message, Bundle):
            if message is not None:
                yield message
            return
        self.bundle = message
        for end, part in zip(message.keys, message.parts, strict=True):
            if not message.may_carry(end):
                text = f"{message.kind} of {message.sender} with a message under the key {end}"
                self.rejections.add(message.sender, MessageError("wrong_sender", text))
            elif self._is_mine(end) and (
                inner := self._checked(f"{self._keys.prefix}/{end}", part)
            ):
                yield inner
        self.bundle = None

    def announce(self, name: str, incarnation: int) -> None:
        """Refuse messages of other incarnations of a process from now on.

        The token of this one has appeared.
        """
        self._incarnations[name] = max(incarnation, self._incarnations.get(name, 0))

    def notices(self, incarnation: int, now_ns: int | None = None) -> list[Rejected]:
        """Return the notices of refusals to publish.

        One batch a second of a monotonic clock; without a time all.
        """
        news = [entry for entry in self.rejections if entry.count > entry.reported]
        if not news or (now_ns is not None and now_ns < self._next_ns):
            return []
        self._next_ns, self._out.incarnation = (now_ns or 0) + _EVERY_NS, incarnation
        messages = []
        for entry in news:
            told = {"offender": entry.sender, "reason": entry.reason, "example": entry.example}
            messages.append(
                self._out.stamp(
                    Rejected, tick=self.tick, count=entry.count - entry.reported, **told
                )
            )
            entry.reported = entry.count
        return messages

    def _checked(self, key: str, data: bytes) -> Message | None:
        """Return the message in some bytes if it passes all checks, and remember its place."""
        sender = self._keys.end(key)
        try:
            message = decode(data)
            sender = message.sender
            self._check_sender(key, message)
            if isinstance(message, Bundle):
                return (
                    message  # its messages have an order, and the same bundle may come with others
                )
            self._check_incarnation(message)
            end = getattr(message, message.route.each) if message.route.each else ""
            stream = (
                message.kind,
                end,
                message.incarnation,
                isinstance(message, Plan) and message.negotiation > 0,
            )
            place, sequence = self._newest.get(stream, ((-1, 0), 0))
            if message.place <= place:
                text = f"{message.kind} {message.place[0]} (number {message.sequence}) after {place[0]}"
                raise MessageError("replayed" if message.sequence <= sequence else "past", text)
            if self._shape is not None:
                check_plausible(message, self._shape)
            if self._check_moment is not None:
                self._check_moment(message)
        except MessageError as error:
            self.rejections.add(error.sender or sender, error)
            return None
        self._newest[stream] = message.place, message.sequence
        if not isinstance(message, LinkChange | Target):  # a repeated one is of the past
            self.tick = max(self.tick, message.tick)
        return message

    def _check_sender(self, key: str, message: Message) -> None:
        self._keys.check_sender(key, message)
        if message.sender == self._name:
            raise MessageError("wrong_sender", f"{message.kind} of this process itself")
        if message.sender not in self._senders:
            raise MessageError("unknown_agent", f"{message.kind} of {message.sender}")
        if (
            self._relayed
            and self.bundle is None
            and isinstance(message, Plan)
            and message.negotiation == 0
        ):
            # The coordinator would count it, but could not relay it.
            raise MessageError(
                "wrong_sender", f"plan of {message.sender} alone, expected it in an answer"
            )

    def _check_incarnation(self, message: Message) -> None:
        announced = self._incarnations.get(message.sender, message.incarnation)
        if (
            message.incarnation > announced
            and isinstance(message, Plan)
            and message.negotiation > 0
        ):
            return  # the first proposal of a new start, which may overtake its token
        # Relayed plans come another way than the token of their agent's start.
        if message.incarnation != announced and (
            self.bundle is None or not message.sender.startswith(AGENT)
        ):
            text = f"{message.kind} of incarnation {message.incarnation}, expected {announced}"
            raise MessageError("wrong_incarnation", text)

    def _receives(self, end: str) -> bool:
        """Return whether this process subscribes to a key, and another one publishes under it."""
        return end not in self._own and any(
            matches(expression, end) for expression in self._subscribed
        )
