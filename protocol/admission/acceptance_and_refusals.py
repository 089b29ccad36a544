"""The gate of a process or of a reader of a log: all checks of a received message.

The checks, in their order; the first that fails gives the reason (docs/reference/protocol.md):

    form           size, version, kind, fields, and the range of their values
    sender         the owner of the key, a process of the run, not this process
    incarnation    the newest start of the sender whose token has arrived
    place          newer than the last accepted message of its stream
    plausibility   agents, UAVs, states and inputs of this run
    moment         of use for the node now

A bundle passes the first two, then each of its messages for this process passes all.
"""

from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from transport.protocol.admission.plausibility import check_plausible
from transport.protocol.wire.bundles import Bundle
from transport.protocol.wire.codec import Header, decode, header_of
from transport.protocol.wire.errors_and_exit_codes import MessageError, Reason
from transport.protocol.wire.key_expressions import Keys, matches
from transport.protocol.wire.message_form import MAX_KEY, MAX_TEXT
from transport.protocol.wire.messages import LinkChange, Message, Plan, Rejected, Target
from transport.protocol.wire.names import (
    AGENT,
    COORDINATOR,
    MAX_UAVS,
    PLANT,
    RECORDER,
    VEHICLE,
    agent_name,
    role_of,
    vehicle_name,
)
from transport.protocol.wire.node_interface import RunShape
from transport.protocol.wire.outbox import Outbox

# Time between two batches of `Rejected` messages, ns.
_EVERY_NS = 1_000_000_000
# Limits of memory, as a sender may invent any key or name; a run has fewer.
_MOST_KEYS = 1024  # of which the gate remembers whether they are for this process
_MOST_COUNTS = 1024  # of refusals, by sender and reason
# Stands for all senders without a count of their own.
OTHERS = "others"


@dataclass(slots=True)
class Rejection:
    """Messages of one sender refused for one reason."""

    # Sender that the messages name; the end of their key, such as "plan/2", where the header cannot be
    # read; `OTHERS` once there are too many counts.
    sender: str
    reason: Reason
    example: str  # error of the first of them
    count: int = 0
    reported: int = 0  # in `Rejected` messages


class Rejections:
    """Counts of one process, which iteration yields in the order they began.

    Once there are `_MOST_COUNTS`, those of further senders are summed for each reason.
    """

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
        key = sender[:MAX_KEY], error.reason
        if key not in self._entries and len(self._entries) >= _MOST_COUNTS:
            key = OTHERS, error.reason
        new = Rejection(*key, str(error)[:MAX_TEXT])
        self._entries.setdefault(key, new).count += 1


@dataclass(frozen=True, slots=True)
class Sample:
    """Event: a message as it came, of which only the header was read."""

    key: str
    data: bytes
    header: Header


class Accepted(NamedTuple):
    """A message that has passed all checks, and the bundle it came in, None if it came alone.

    Of a sample only the header has been read.
    """

    message: Message | Sample
    bundle: Bundle | None = None


class Stream(NamedTuple):
    """Messages that follow each other in an order, each of which a newer one makes obsolete."""

    kind: str
    end: object  # of their key: an agent or a sender, empty where there is one key for all
    incarnation: int
    # Proposals of a negotiation have an order of their own: they come alone, and may overtake the
    # plan of the tick before.
    is_proposal: bool


class Newest(NamedTuple):
    """The newest message of a stream: its place in the order, and its sequence number."""

    place: tuple[int, int] = (-1, 0)
    sequence: int = 0


class Gate:
    """Checks of the messages that one process receives.

    Without a shape (the run is not known) agents and plausibility are not checked. `check_moment`
    refuses messages that the node cannot use, None for a reader of a log; `unread` are kinds that
    are handed over as samples.

    Attributes:
        rejections: Refused messages.
        tick: Newest tick of an accepted message, other than link changes, targets and samples.
    """

    def __init__(
        self,
        name: str,
        keys: Keys,
        shape: RunShape | None = None,
        check_moment: Callable[[Message], None] | None = None,
        unread: Collection[str] = (),
    ) -> None:
        self._name = name
        self._keys = keys
        self._shape = shape
        self._check_moment = check_moment
        self._unread = unread
        self.rejections = Rejections()
        self.tick = 0

        agents = range(1, MAX_UAVS + 1) if shape is None else shape.owned
        self._senders = {COORDINATOR, PLANT, RECORDER, *map(agent_name, agents)}
        # None: either, in a run that is not known.
        self._by_vehicles = None if shape is None else shape.by_vehicles
        if self._by_vehicles is not False:
            uavs = MAX_UAVS if shape is None else shape.uavs
            self._senders |= {vehicle_name(uav) for uav in range(1, uavs + 1)}
        self._relayed = shape is not None and shape.relayed
        self._subscribed = [keys.end(key) for key in keys.subscriptions(name)]
        self._own = {keys.end(key) for key in keys.publications(name)}
        self._is_mine = lru_cache(maxsize=_MOST_KEYS)(self._receives)

        self._incarnations: dict[str, int] = {}  # newest announced, by sender
        self._newest: dict[Stream, Newest] = {}
        self._out = Outbox(name, 0)  # of notices of refusals
        self._next_notices_ns = 0

    def accept(self, key: str, data: bytes) -> Iterator[Accepted]:
        """Yield the messages in some bytes that pass all checks.

        Each is to be handled before the next is asked for: `check_moment` judges by the state of the
        node.
        """
        sample = self._sample(key, data)
        if sample is not None:
            yield Accepted(sample)
            return

        message = self._checked(key, data, None)
        if isinstance(message, Bundle):
            yield from self._unpacked(message)
        elif message is not None:
            yield Accepted(message)

    def announce(self, name: str, incarnation: int) -> None:
        """Note that the token of a start of a process has arrived.

        Messages of its other starts are refused, but for those that `_check_incarnation` names.
        """
        self._incarnations[name] = max(incarnation, self._incarnations.get(name, 0))

    def notices(self, incarnation: int, now_ns: int | None = None) -> list[Rejected]:
        """Return the notices of new refusals to publish, at most one batch a second.

        Args:
            incarnation: Start of this process that publishes them.
            now_ns: Time of a monotonic clock; None at the end, when the last batch does not wait.
        """
        unreported = [entry for entry in self.rejections if entry.count > entry.reported]
        if not unreported:
            return []
        if now_ns is not None:
            if now_ns < self._next_notices_ns:
                return []
            self._next_notices_ns = now_ns + _EVERY_NS
        self._out.incarnation = incarnation

        messages = []
        for entry in unreported:
            notice = self._out.stamp(
                Rejected,
                tick=self.tick,
                offender=entry.sender,
                reason=entry.reason,
                count=entry.count - entry.reported,
                example=entry.example,
            )
            entry.reported = entry.count
            messages.append(notice)
        return messages

    def _sample(self, key: str, data: bytes) -> Sample | None:
        """Return a message of an unread kind as it came, None for other kinds."""
        if self._unread:
            with suppress(MessageError):
                header = header_of(data)
                if header.kind in self._unread:
                    return Sample(key, data, header)
        return None

    def _unpacked(self, bundle: Bundle) -> Iterator[Accepted]:
        """Yield the messages of a bundle for this process that pass all checks."""
        for end, part in zip(bundle.keys, bundle.parts, strict=True):
            if not bundle.may_carry(end):
                text = f"{bundle.kind} of {bundle.sender} with a message under the key {end}"
                self.rejections.add(bundle.sender, MessageError("wrong_sender", text))
                continue
            if not self._is_mine(end):
                continue
            message = self._checked(f"{self._keys.prefix}/{end}", part, bundle)
            if message is not None:
                yield Accepted(message, bundle)

    def _checked(self, key: str, data: bytes, bundle: Bundle | None) -> Message | None:
        """Return the message in some bytes if it passes all checks, and remember its place."""
        sender = self._keys.end(key)
        try:
            message = decode(data)
            sender = message.sender
            self._check_sender(key, message, bundle)
            if isinstance(message, Bundle):
                # A bundle has no place of its own: each of its messages is checked by itself.
                return message
            self._check_incarnation(message, bundle)
            stream = _stream_of(message)
            self._check_place(message, stream)
            if self._shape is not None:
                check_plausible(message, self._shape)
            if self._check_moment is not None:
                self._check_moment(message)
        except MessageError as error:
            self.rejections.add(error.sender or sender, error)
            return None

        self._newest[stream] = Newest(message.place, message.sequence)
        if not isinstance(message, LinkChange | Target):
            # Changes of links and targets have the tick of their effect, which is not open yet.
            self.tick = max(self.tick, message.tick)
        return message

    def _check_place(self, message: Message, stream: Stream) -> None:
        """Refuse a message that is not newer than the newest of its stream."""
        newest = self._newest.get(stream, _NOTHING)
        if message.place > newest.place:
            return
        text = f"{message.kind} {message.place[0]} (number {message.sequence})"
        reason: Reason = "replayed" if message.sequence <= newest.sequence else "past"
        raise MessageError(reason, f"{text} after {newest.place[0]}")

    def _check_sender(self, key: str, message: Message, bundle: Bundle | None) -> None:
        """Refuse a message under a wrong key, of this process itself, or of a stranger."""
        self._keys.check_sender(key, message)
        if message.sender == self._name:
            raise MessageError("wrong_sender", f"{message.kind} of this process itself")
        if message.sender not in self._senders:
            raise MessageError("unknown_agent", f"{message.kind} of {message.sender}")

        if message.route.by_vehicles and self._by_vehicles is not None:
            expected = VEHICLE if self._by_vehicles else PLANT
            if role_of(message.sender) != expected:
                text = f"{message.kind} of {message.sender}, expected it from the {expected}"
                raise MessageError("wrong_sender", text)

        is_alone = bundle is None and isinstance(message, Plan) and message.negotiation == 0
        if self._relayed and is_alone:
            # The coordinator would count it, but could not relay it.
            text = f"plan of {message.sender} alone, expected it in an answer"
            raise MessageError("wrong_sender", text)

    def _check_incarnation(self, message: Message, bundle: Bundle | None) -> None:
        """Refuse a message of another incarnation of its sender than the one announced."""
        announced = self._incarnations.get(message.sender, message.incarnation)
        if message.incarnation == announced:
            return
        is_proposal = isinstance(message, Plan) and message.negotiation > 0
        if is_proposal and message.incarnation > announced:
            return  # the first proposal of a new start, which may overtake its token
        if bundle is not None and message.sender.startswith(AGENT):
            # Plans and reports, of an agent itself or relayed: relays come another way than the
            # token of the agent's start. The roster decides which start a plan has to be of
            # (`check_moment` of the nodes); a report changes no process.
            return
        text = f"{message.kind} of incarnation {message.incarnation}, expected {announced}"
        raise MessageError("wrong_incarnation", text)

    def _receives(self, end: str) -> bool:
        """Return whether this process subscribes to a key, and another one publishes under it."""
        if end in self._own:
            return False
        return any(matches(expression, end) for expression in self._subscribed)


_NOTHING = Newest()


def _stream_of(message: Message) -> Stream:
    """Return the stream a message belongs to."""
    each = message.route.each
    end = getattr(message, each) if each else ""
    is_proposal = isinstance(message, Plan) and message.negotiation > 0
    return Stream(message.kind, end, message.incarnation, is_proposal)
