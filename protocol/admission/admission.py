"""The way in: bytes under a key become a message of the run, or are refused and counted.

What is checked here needs nothing but what has come in before: size, form, key, sender, which start of it, and the
order of its messages. Whether a message fits the run and the moment is for the node to say.

Zenoh keeps the order of one sender's messages under one key, and no other. So each key counts for itself, and each
kind under it. What grows is the tick for kinds that each tick brings, the version for rosters, and the sequence number
for all others. Higher numbers do not count where ticks do: whoever has the sender's key as well and numbers higher than
it could keep all it says from being heard, and the run would hang on what he repeats. That a number is there twice is
held against the second all the same.
"""

import threading
from collections import deque
from dataclasses import dataclass

from model.state import INPUTS, PAYLOAD, PER_UAV
from protocol.admission.plausibility import window
from protocol.scenario.setup import Setup
from protocol.wire.codec import MAX_BYTES, decode
from protocol.wire.header import Header, Place, header_of, place_of
from protocol.wire.keys import Keys
from protocol.wire.messages import (
    LinkChange,
    Message,
    MessageError,
    Reason,
    Rejected,
    agent_name,
)
from protocol.wire.rejections import MAX_SENDERS, Notices, Rejections

# What a message needs besides its arrays, with the longest texts and lists it may have.
_FRAME_BYTES = 16 * 1024

# Messages kept for a token to come, of all senders together: a moment's worth.
_KEPT = 256

# How many of the last numbers under a key are known: a garbled tick does not make an old message new.
_NUMBERS = 1024

# How many ticks a message may be ahead of all others here: more than any connection is slower than another.
_AHEAD = 16


@dataclass(frozen=True, slots=True)
class _Heard:
    """The newest message of a kind under a key."""

    sender: str
    incarnation: int
    sequence: int
    place: Place | None


class Admission:
    """What one process lets in.

    A message counts as heard when the next one is read and it has not been refused in between: what its node does
    not believe must not stand in the way of the real one.

    Args:
        name: The process's.
        keys: Key expressions of the run.
        setup: The run.
        rejections: Where refusals are counted; those of the node as well.

    Attributes:
        max_bytes: Size of the largest message of the run, or a little more.
        tick: Newest tick of a message heard.
        window: How many ticks from that a message can be that is for now.
    """

    def __init__(self, name: str, keys: Keys, setup: Setup, rejections: Rejections) -> None:
        self.max_bytes = _max_bytes(setup)
        self.tick = 0
        self._name = name
        self._keys = keys
        self._rejections, self._notices = rejections, Notices(name, rejections)
        self._senders = {"coordinator", "plant", "recorder", *map(agent_name, setup.agents)}
        self.window = max(_AHEAD, window(setup))
        self._is_up_to_date = False  # whether `tick` is where the run is
        self._announced: dict[str, int] = {}  # newest incarnation, by name
        self._heard: dict[tuple[str, str], _Heard] = {}  # by key and kind
        self._numbers: dict[tuple[str, str], dict[int, None]] = {}  # of messages heard, in their order
        self._unread: dict[tuple[str, Reason], tuple[MessageError, int]] = {}  # refused as they came, by sender
        self._counting = threading.Lock()  # of them: several threads receive
        self._given: tuple[str, Message, int] | None = None  # the last one let in: key, message, refusals before it
        self._early: deque[tuple[str, Message]] = deque()  # waiting for their sender's token
        self._released: deque[tuple[str, Message]] = deque()  # no longer

    def has_passed(self, key: str, data: bytes) -> bool:
        """Whether a message that comes in need not be read, as what it says is over; if so it is counted.

        Safe on any thread. What it refuses `read` would refuse as well, however much later.

        Args:
            key: What it came under.
            data: Its bytes.
        """
        try:
            header = header_of(data)
            if header is not None and header.sender == self._name:
                raise MessageError("wrong_sender", f"{header.kind} of this process itself", header.sender)
            heard = None if header is None else self._heard.get((key, header.kind))
            if (
                header is None
                or heard is None
                or (header.sender, header.incarnation) != (heard.sender, heard.incarnation)
            ):
                return False
            _check_new(header, header.place, heard)
        except MessageError as error:
            sender = error.sender or self._keys.end(key)
            with self._counting:
                first, count = self._unread.get((sender, error.reason), (error, 0))
                # Senders can be anything: those beyond a moment's worth are counted where they are told apart.
                if count == 0 and len(self._unread) >= MAX_SENDERS:
                    return False
                self._unread[sender, error.reason] = first, count + 1
            return True
        return False

    def count_unread(self) -> None:
        """Count what was refused as it came since the last time; for the thread that reads."""
        if not self._unread:
            return
        self._settle()
        with self._counting:
            unread, self._unread = self._unread, {}
        for (sender, _), (error, count) in unread.items():
            self._rejections.add(sender, error, count)

    def read(self, key: str, data: bytes) -> Message | None:
        """The message in what came in; None if it is refused, or kept because its sender is not announced yet.

        Args:
            key: What it came under.
            data: Its bytes.
        """
        self._settle()
        try:
            if len(data) > self.max_bytes:
                raise self.oversized(len(data))
            message = decode(data)
            self._keys.check_sender(key, message)
            if message.sender == self._name:
                raise MessageError("wrong_sender", f"{message.kind} of this process itself", message.sender)
            if message.sender not in self._senders:
                raise MessageError("unknown_agent", f"{message.kind} of {message.sender}", message.sender)
            announced = self._announced.get(message.sender, -1)
            if message.incarnation < announced:
                raise _wrong_incarnation(message)
            if message.incarnation > announced:
                self._keep(key, message)
                return None
            self._check_order(key, message)
        except MessageError as error:
            self.refuse(key, error)
            return None
        return self._give(key, message)

    def announce(self, name: str, incarnation: int) -> None:
        """A process's token is here: from now on its messages are believed, those of an earlier start no longer.

        Said again, it means that the process was out of reach for a while, or this one was; said of this one, that
        it has started anew. What it was told before does not say where the run is now.
        """
        self._settle()
        if name in self._announced or name == self._name:
            self._is_up_to_date = False
        self._announced[name] = max(incarnation, self._announced.get(name, -1))
        waiting, self._early = self._early, deque()
        for key, message in waiting:
            ahead = message.incarnation > self._announced.get(message.sender, -1)
            (self._early if ahead else self._released).append((key, message))

    def released(self) -> Message | None:
        """The next message that was kept and can now be handled, or None."""
        self._settle()
        while self._released:
            key, message = self._released.popleft()
            try:
                if message.incarnation < self._announced[message.sender]:
                    raise _wrong_incarnation(message)
                self._check_order(key, message)
            except MessageError as error:
                self.refuse(key, error)
                continue
            return self._give(key, message)
        return None

    @property
    def refused(self) -> int:
        """How many messages were refused so far, here and by the node."""
        return self._rejections.total

    @property
    def kept(self) -> int:
        """How many messages wait for their sender's token."""
        return len(self._early)

    def refuse(self, key: str, error: MessageError) -> None:
        """Count something that came under a key and is not let in."""
        self._settle()
        self._rejections.add(error.sender or self._keys.end(key), error)

    def oversized(self, size: int) -> MessageError:
        """Why so many bytes are refused."""
        return MessageError("oversized", f"message of {size} bytes, at most {self.max_bytes} in this run")

    def close(self) -> None:
        """Nothing comes any more: what was kept is refused."""
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

    def _check_order(self, key: str, message: Message) -> None:
        if self._is_up_to_date and message.tick > self.tick + self.window:
            text = f"{message.kind} of tick {message.tick}, the newest here is {self.tick}"
            raise MessageError("future", text, message.sender)
        heard = self._heard.get((key, message.kind))
        if heard is None or message.incarnation > heard.incarnation:
            return
        _check_new(message, place_of(message), heard)
        if message.sequence in self._numbers[key, message.kind]:
            raise MessageError("replayed", f"{message.kind} number {message.sequence} again", message.sender)

    def _give(self, key: str, message: Message) -> Message:
        self._given = key, message, self._rejections.total
        return message

    def _settle(self) -> None:
        """Remember the last message let in, if it has not been refused."""
        if self._given is None:
            return
        key, message, refused = self._given
        self._given = None
        if self._rejections.total == refused:
            at = key, message.kind
            before = self._heard.get(at)
            if before is None or message.incarnation != before.incarnation:
                self._numbers[at] = {}
            numbers = self._numbers[at]
            numbers[message.sequence] = None
            if len(numbers) > _NUMBERS:
                del numbers[next(iter(numbers))]
            self._heard[at] = _Heard(message.sender, message.incarnation, message.sequence, place_of(message))
            if not isinstance(message, LinkChange):  # told again, it is of the past
                self.tick = max(self.tick, message.tick)
                self._is_up_to_date = True


def _check_new(said: Message | Header, place: Place | None, heard: _Heard) -> None:
    """Refuse what has been said of its kind under its key."""
    known = said.sequence <= heard.sequence
    if place is None or heard.place is None:
        if known:
            text = f"{said.kind} number {said.sequence} after number {heard.sequence}"
            raise MessageError("replayed", text, said.sender)
    elif place <= heard.place:
        text = f"{said.kind} {place[0]} after {heard.place[0]}"
        raise MessageError("replayed" if known else "past", text, said.sender)


def _wrong_incarnation(message: Message) -> MessageError:
    text = f"{message.kind} of incarnation {message.incarnation}, which is over or was never announced"
    return MessageError("wrong_incarnation", text, message.sender)


def _max_bytes(setup: Setup) -> int:
    """The largest message is a plan for all UAVs or the truth of all; anything larger is not ours."""
    per_uav = PER_UAV + 2 * INPUTS * setup.settings.horizon
    return min(MAX_BYTES, _FRAME_BYTES + 8 * (PAYLOAD + setup.system.N * per_uav))
