"""Admission: received bytes become a message of the run, or are refused and counted.

The checks here depend only on earlier messages: size, form, key, sender, its incarnation, and the messages' order.
`protocol.admission.reception` checks whether a message fits the run and the tick.

Zenoh keeps the order of one sender's messages under one key only, so order is checked by key and kind. The tick must
grow for kinds sent once a tick, the version for rosters, and the sequence number for all others. Where ticks count,
higher sequence numbers do not: otherwise an attacker with the sender's key could number its messages higher, and all
true messages would be refused. A sequence number that occurs twice is refused all the same.

With relayed plans messages reach one key by two routes: a proposal of a negotiation comes alone and may overtake the
plan of the tick before, which the coordinator relays. So proposals have an order of their own. An answer counts for the
order of later ones only once its plan is accepted: a forged one without a true plan must not block the true answer.
Other bundles have no order: their ticks need not grow, and copies under higher sequence numbers would block the true
ones.

More than 300 lines, a third of them about why: all checks share the counts and the order of what came before.
"""

import threading
from collections import deque
from collections.abc import Callable, Collection

from model.state import INPUTS, PAYLOAD, PER_UAV
from protocol.admission.order import Newest, check_new, place_in
from protocol.admission.plausibility import window
from protocol.admission.samples import Sample, Samples
from protocol.scenario.setup import Setup
from protocol.wire.codec import MAX_BYTES, decode
from protocol.wire.header import Header, Place, header_of
from protocol.wire.keys import Keys
from protocol.wire.messages import (
    BUNDLES,
    MAX_TICK,
    Answer,
    Bundle,
    LinkChange,
    Message,
    MessageError,
    Plan,
    Reason,
    Rejected,
    Relay,
    Roster,
    agent_name,
)
from protocol.wire.names import COORDINATOR, MAX_UAVS, PLANT, RECORDER
from protocol.wire.rejections import MAX_SENDERS, Notices, Rejections

# Size of a message without its arrays, with the longest texts and lists it may have.
_FRAME_BYTES = 16 * 1024

# Messages of all senders kept until their senders are announced: a moment's worth.
_KEPT = 256

# Sequence numbers remembered per key and kind: a changed tick does not make an old message new.
_NUMBERS = 1024

# How many ticks a message may be ahead of all others: more than one connection is slower than another.
_AHEAD = 16


class Admission:
    """Admission of messages to one process.

    A message counts for the order of later ones only if the node has not refused it by the time the next one is read:
    a forged message that the node sees through must not block the true one.

    Args:
        name: The process.
        keys: Keys of the run.
        setup: The run; None where it is not known: sizes, senders and moments are not checked then.
        rejections: Counts of refused messages.
        unread: Kinds that `take` hands over as samples.
        on_announced: Called with name and incarnation of each process whose token has appeared.
        refuses_lone_plans: Whether plans are relayed, so that none comes alone but proposals of a negotiation.

    Attributes:
        rejections: Counts of refused messages, also those that the node refuses.
        max_bytes: Upper bound of the size of the run's messages.
        tick: Newest tick of an admitted message.
        window: How many ticks from `tick` a present message can be.
    """

    def __init__(
        self,
        name: str,
        keys: Keys,
        setup: Setup | None,
        rejections: Rejections,
        unread: Collection[str] = (),
        on_announced: Callable[[str, int], None] = lambda *_: None,
        *,
        refuses_lone_plans: bool = False,
    ) -> None:
        self.max_bytes = MAX_BYTES if setup is None else _max_bytes(setup)
        # Answers that fill a relay must leave room in it for those of the other agents.
        self._max_answer = {} if setup is None else {agent: _max_answer(setup, agent) for agent in setup.agents}
        self._refuses_lone_plans = refuses_lone_plans
        self.tick = 0
        self._name = name
        self._keys = keys
        self.rejections, self._notices = rejections, Notices(name, rejections)
        agents = range(1, MAX_UAVS + 1) if setup is None else setup.agents
        self._senders = {COORDINATOR, PLANT, RECORDER, *map(agent_name, agents)}
        self._samples = Samples(unread, keys, agents)
        self._on_announced = on_announced
        self.window = MAX_TICK if setup is None else max(_AHEAD, window(setup))
        self._is_up_to_date = False  # whether `tick` is the present tick of the run
        # This process's new incarnation while no roster has it: messages until then are those it missed.
        self._returning: int | None = None
        self._announced: dict[str, int] = {}  # newest incarnation, by name
        self._newest: dict[tuple[str, str, bool], Newest] = {}  # by key, kind, and whether it is a proposal
        self._newest_bundles: dict[str, int] = {}  # ticks of those that `follows` has counted, by key
        # Incarnations and sequence numbers in their order, by key and kind.
        self._numbers: dict[tuple[str, str], dict[tuple[int, int], None]] = {}
        self._unread: dict[tuple[str, Reason], tuple[MessageError, int]] = {}  # refused on arrival, by sender
        self._counting = threading.Lock()  # for `_unread`: several threads receive
        # The last admitted message, with its key, the refusals before it, and the bundle it came in.
        self._last: tuple[str, Message, int, Bundle | None] | None = None
        self._early: deque[tuple[str, Message]] = deque()  # messages that wait for their sender's token
        self._released: deque[tuple[str, Message]] = deque()  # messages whose sender's token has come

    def has_passed(self, key: str, data: bytes) -> bool:
        """Return whether a message is outdated and need not be read; if so, count it.

        Safe on any thread. It refuses only messages that `read` would refuse at any later time as well.
        """
        if key.startswith(self._keys.left("")):
            return False  # it has no content, and is not read as a message
        try:
            header = header_of(data)
            if header is not None and header.sender == self._name:
                raise MessageError("wrong_sender", f"{header.kind} of this process itself", header.sender)
            newest = None if header is None else self._newest.get(_stream(key, header.kind, header.place))
            if header is None or newest is None:
                return False
            if (header.sender, header.incarnation) != (newest.sender, newest.incarnation):
                return False
            check_new(header, header.place, newest)
        except MessageError as error:
            sender = error.sender or self._keys.end(key)
            with self._counting:
                first, count = self._unread.get((sender, error.reason), (error, 0))
                # Forged senders can be many: those beyond the limit are left to `read`.
                if count == 0 and len(self._unread) >= MAX_SENDERS:
                    return False
                self._unread[sender, error.reason] = first, count + 1
            return True
        return False

    def count_unread(self) -> None:
        """Count the messages that `has_passed` has refused since the last call; for the thread that reads."""
        if not self._unread:
            return
        self._remember_last()
        with self._counting:
            unread, self._unread = self._unread, {}
        for (sender, _), (error, count) in unread.items():
            self.rejections.add(sender, error, count)

    def take(self, key: str, data: bytes) -> Message | Sample | None:
        """Return the sample or message in some bytes; None as for `read`, which reads all that are not handed over."""
        sample = self._samples.take(key, data)
        return self.read(key, data) if sample is None or self._is_lone_plan(sample.header) else sample

    def follows(self, sample: Sample) -> bool:
        """Return whether a sample is in order by its header; if so, it counts for the order of later ones.

        As the rest of it may be garbled, it is at most one tick ahead: a run has no greater steps.
        """
        header = sample.header
        if header.incarnation != self._announced.get(header.sender):
            return False
        if self._is_up_to_date and header.tick > self.tick + 1:
            return False
        if header.kind in BUNDLES:  # without an order: a copy under a higher number must not block the true ones
            if header.tick < self._newest_bundles.get(sample.key, 0):
                return False
            self._newest_bundles[sample.key] = header.tick
        else:
            try:
                self._check_order(sample.key, header)
            except MessageError:
                return False
            self._remember(sample.key, header)
        self._note_tick(header)
        return True

    def read(self, key: str, data: bytes, bundle: Bundle | None = None) -> Message | None:
        """Return the message in some bytes; None if it is refused, or kept because its sender is not announced yet.

        `bundle` is the one the message came in.
        """
        self._remember_last()
        try:
            if len(data) > self.max_bytes:
                raise self.oversized(len(data))
            message = decode(data)
            self._keys.check_sender(key, message)
            if message.sender == self._name:
                raise MessageError("wrong_sender", f"{message.kind} of this process itself", message.sender)
            if message.sender not in self._senders:
                raise MessageError("unknown_agent", f"{message.kind} of {message.sender}", message.sender)
            most = self._max_answer.get(message.agent, 0) if isinstance(message, Answer) else self.max_bytes
            if len(data) > most:
                text = f"answer of {len(data)} bytes, at most {most} of {message.sender}"
                raise MessageError("oversized", text, message.sender)
            self._check_route(message, bundle)
            announced = self._announced.get(message.sender, -1)
            # The token of an agent's next start may overtake its last plan on the way through the coordinator.
            if message.incarnation < announced and not isinstance(bundle, Relay):
                raise _wrong_incarnation(message)
            if message.incarnation > announced:
                self._keep(key, message)
                return None
            self._check_order(key, message)
        except MessageError as error:
            self.refuse(key, error)
            return None
        return self._admit(key, message, bundle)

    def announce(self, name: str, incarnation: int) -> None:
        """Admit messages of an incarnation whose token has appeared, and no longer those of earlier ones.

        A process that is announced again was unreachable, or this process was: `tick` may be out of date.
        """
        self._remember_last()
        if name in self._announced:
            self._is_up_to_date = False
        self._announced[name] = max(incarnation, self._announced.get(name, -1))
        waiting, self._early = self._early, deque()
        for key, message in waiting:
            ahead = message.incarnation > self._announced.get(message.sender, -1)
            (self._early if ahead else self._released).append((key, message))
        self._on_announced(name, incarnation)

    def renew(self, incarnation: int) -> None:
        """Announce a new incarnation of this process, which comes back to the team.

        It still reads the messages that it missed, those of each connection by themselves: `tick` is the present one
        only from the roster on that has this incarnation.
        """
        self.announce(self._name, incarnation)
        self._returning, self._is_up_to_date = incarnation, False

    def released(self) -> Message | None:
        """Return the next message that was kept and can now be handled, or None."""
        self._remember_last()
        while self._released:
            key, message = self._released.popleft()
            try:
                if message.incarnation < self._announced[message.sender]:
                    raise _wrong_incarnation(message)
                self._check_order(key, message)
            except MessageError as error:
                self.refuse(key, error)
                continue
            return self._admit(key, message)
        return None

    @property
    def kept(self) -> int:
        """Number of messages that wait for their sender's token."""
        return len(self._early)

    def refuse(self, key: str, error: MessageError) -> None:
        """Count a refused message."""
        self._remember_last()
        self.rejections.add(error.sender or self._keys.end(key), error)

    def oversized(self, size: int) -> MessageError:
        """Return the error of an oversized message."""
        return MessageError("oversized", f"message of {size} bytes, at most {self.max_bytes} in this run")

    def close(self) -> None:
        """Refuse the messages that are still kept, at the end of the process."""
        self.count_unread()
        for key, message in self._early:
            self.refuse(key, _wrong_incarnation(message))
        self._early.clear()

    def due_notices(self, now_ns: int, incarnation: int) -> list[Rejected]:
        """Return the notices about refused messages that are to be published now; see `Notices.due`."""
        return self._notices.due(now_ns, incarnation, self.tick)

    def remaining_notices(self, incarnation: int) -> list[Rejected]:
        """Return the notices about refused messages that were not published yet; for the end of the process."""
        return self._notices.rest(incarnation, self.tick)

    def _keep(self, key: str, message: Message) -> None:
        self._early.append((key, message))
        if len(self._early) > _KEPT:
            oldest_key, oldest = self._early.popleft()
            self.refuse(oldest_key, _wrong_incarnation(oldest))

    def _check_route(self, message: Message, bundle: Bundle | None) -> None:
        """Refuse a plan that comes alone in a run with relayed plans: the coordinator would count, not relay it."""
        if bundle is None and self._is_lone_plan(message):
            text = f"plan of {message.sender} alone, expected it in an answer"
            raise MessageError("wrong_sender", text, message.sender)

    def _is_lone_plan(self, message: Message | Header) -> bool:
        """Return whether a message that came alone should have come in an answer: a plan that is no proposal."""
        return self._refuses_lone_plans and message.kind == Plan.kind and place_in(message) == (message.tick, 0)

    def _check_order(self, key: str, message: Message | Header) -> None:
        if self._is_up_to_date and message.tick > self.tick + self.window:
            text = f"{message.kind} of tick {message.tick}, the newest here is {self.tick}"
            raise MessageError("future", text, message.sender)
        place = place_in(message)
        newest = self._newest.get(_stream(key, message.kind, place))
        if newest is not None and message.incarnation <= newest.incarnation:
            check_new(message, place, newest)
        if (message.incarnation, message.sequence) in self._numbers.get((key, message.kind), ()):
            raise MessageError("replayed", f"{message.kind} number {message.sequence} again", message.sender)

    def _admit(self, key: str, message: Message, bundle: Bundle | None = None) -> Message:
        if not isinstance(message, Bundle):
            self._last = key, message, self.rejections.total, bundle
        return message

    def _remember_last(self) -> None:
        """Remember the place of the last admitted message, unless the node has refused it."""
        if self._last is None:
            return
        key, message, refused, bundle = self._last
        self._last = None
        if self.rejections.total != refused:
            return
        self._remember(key, message)
        if isinstance(bundle, Answer) and bundle.tick == message.tick:
            self._remember(self._keys.of(bundle), bundle)
        self._note_tick(message)

    def _note_tick(self, message: Message | Header) -> None:
        if message.kind == LinkChange.kind:  # a repeated change is of the past
            return
        self.tick = max(self.tick, message.tick)
        if isinstance(message, Roster):
            incarnations = {
                agent_name(agent): inc for agent, inc in zip(message.agents, message.incarnations, strict=True)
            }
            if incarnations.get(self._name) == self._returning:
                self._returning = None
        self._is_up_to_date = self._returning is None

    def _remember(self, key: str, message: Message | Header) -> None:
        numbers = self._numbers.setdefault((key, message.kind), {})
        numbers[message.incarnation, message.sequence] = None
        if len(numbers) > _NUMBERS:
            del numbers[next(iter(numbers))]
        place = place_in(message)
        newest = Newest(message.sender, message.incarnation, message.sequence, place)
        self._newest[_stream(key, message.kind, place)] = newest


def _stream(key: str, kind: str, place: Place | None) -> tuple[str, str, bool]:
    """Return what messages are ordered by: key, kind, and whether it is a proposal of a negotiation."""
    return key, kind, kind == Plan.kind and place is not None and place[1] < 0


def _wrong_incarnation(message: Message) -> MessageError:
    text = f"{message.kind} of incarnation {message.incarnation}, which has ended or was never announced"
    return MessageError("wrong_incarnation", text, message.sender)


def _max_bytes(setup: Setup) -> int:
    """Return the size of the largest message: plans for all UAVs, or the plant state; in bundles also measurements."""
    size = _FRAME_BYTES + 8 * PAYLOAD
    if setup.scenario.clock.relayed:
        size += sum(_max_answer(setup, agent) for agent in setup.agents)
    else:
        size += 8 * setup.system.N * _per_uav(setup)
    return min(MAX_BYTES, size)


def _max_answer(setup: Setup, agent: int) -> int:
    """Return the size of an agent's largest answer: a plan for its UAVs, and a report."""
    return 2 * _FRAME_BYTES + 8 * (PAYLOAD + len(setup.owned[agent - 1]) * _per_uav(setup))


def _per_uav(setup: Setup) -> int:
    """Return the most numbers of a UAV in the messages of a tick: state and plan, or state and measurement."""
    return max(PER_UAV + 2 * INPUTS * setup.settings.horizon, 2 * (PER_UAV + INPUTS))
