"""Event model of the channel: carrier sense, backoff, collisions, capture, acknowledgements, queues.

Stations are numbered from 0. Times are integers, ns, of one common clock. The model follows the distributed
coordination function of IEEE 802.11-2020, clause 10.3; docs/radio.md states what is simplified.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from protocol.radio.draws import uniform
from protocol.radio.reception import CERTAIN_MARGIN, success
from protocol.radio.standard import OVERHEAD_BYTES, ACK_BYTES, Standard


class Result(IntEnum):
    """Fate of a frame at one receiver."""

    DELIVERED = 0
    COLLISION = 1  # another transmission, also the receiver's own
    WEAK = 2  # below the sensitivity, or too weak for the rate: lost on an idle channel as well
    QUEUE = 3  # the sender's queue was full
    RETRIES = 4  # no acknowledgement after the last attempt


class Frame(NamedTuple):
    """One message for the air. Broadcast to all of its receivers, or sent to each in turn if unicast."""

    sent_ns: int  # instant at which the sender queues the frame
    sender: int
    sequence: int  # number among the sender's frames; frames of one sender and instant are queued in its order
    message_bytes: int
    receivers: tuple[int, ...]


class Outcome(NamedTuple):
    """Fate of a frame at one receiver, and the instant of arrival or loss."""

    frame: Frame
    receiver: int
    result: Result
    time_ns: int

    @property
    def delay_ns(self) -> int:
        """Time from the send to the arrival or loss, ns."""
        return self.time_ns - self.frame.sent_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelParameters:
    """Settings of the channel; powers in mW, as `propagation.Powers` has them."""

    standard: Standard
    rate_mbps: float
    unicast: bool
    queue_length: int  # frames of one station, the one on the air included
    attempts: int  # transmissions of a unicast frame at most
    noise_mw: float
    sensitivity_mw: float  # a weaker preamble is not detected
    preamble_sinr: float  # ratio that the detection of a preamble needs
    payload_sinr: float  # ratio that the payload requires, `Standard.required_sinr_db`
    acknowledgement_sinr: float
    carrier_sense_mw: float  # total power at which the medium is busy without a detected preamble
    interrupted_wait_draws: bool = True  # see docs/radio.md, "A frame that meets an idle medium"
    seed: int = 0


@dataclass(frozen=True, slots=True)
class ChannelState:
    """Queues, backoffs and transmissions in progress, from one window to the next. Compared by value."""

    queues: tuple[tuple["Pending", ...], ...]
    slots: tuple[int, ...]
    backoff_from: tuple[int, ...]
    windows: tuple[int, ...]
    busy_until: tuple[int, ...]
    error_until: tuple[int, ...]
    drawn: tuple[int, ...]
    sent: tuple[int, ...]
    sending: tuple[bool, ...]
    immediate: tuple[bool, ...]
    wake: tuple[int, ...]
    air: tuple["Transmission", ...]
    events: tuple["Event", ...]
    busy_from: int = 0

    @classmethod
    def idle(cls, stations: int, standard: Standard) -> "ChannelState":
        """Return the state of a channel that has been idle."""
        zeros = (0,) * stations
        return cls(
            queues=((),) * stations,
            slots=zeros,
            backoff_from=zeros,
            windows=(standard.cw_min,) * stations,
            busy_until=zeros,
            error_until=zeros,
            drawn=zeros,
            sent=zeros,
            sending=(False,) * stations,
            immediate=(False,) * stations,
            wake=(_NEVER,) * stations,
            air=(),
            events=(),
        )


class Pending(NamedTuple):
    """A frame in a queue, for one receiver if unicast."""

    frame: Frame
    receiver: int  # -1: broadcast
    attempts: int
    delivered: bool  # the receiver has it, its acknowledgement was lost
    queued_ns: int


@dataclass(slots=True)
class Counts:
    """Numbers of a window."""

    transmissions: int = 0
    acknowledgements: int = 0
    repeated: int = 0  # transmissions after the first one of a unicast frame
    busy_ns: int = 0  # time in which at least one station transmits


@dataclass(slots=True)
class Transmission:
    """A frame or an acknowledgement on the air. Sets of stations are bit masks."""

    sender: int
    start_ns: int
    end_ns: int
    number: int  # among the sender's data or acknowledgements
    acknowledges: int = -1  # station whose frame it acknowledges; -1: data
    alone: bool = True  # no other transmission overlaps
    candidates: int = 0  # stations that may still detect its preamble
    locked: int = 0  # stations that receive it
    overlapping: list[int] = field(default_factory=list)  # senders of transmissions that overlap


class Event(NamedTuple):
    """Something at an instant; events of one instant happen in the order of their kinds, then stations."""

    time_ns: int
    kind: int
    station: int
    order: int  # of the frame, for sends
    subject: Frame | None


_NEVER = 2**62
_BROADCAST = -1
# Kinds of events in their order within an instant.
_END, _DETECT, _TIMEOUT, _ACKNOWLEDGE, _SEND, _ATTEMPT = range(6)


class Window:
    """The channel during one window of time. `advance` is its only user."""

    def __init__(self, parameters: ChannelParameters, state: ChannelState, powers: Sequence[Sequence[float]]) -> None:
        self._p = parameters
        self._power = powers
        standard = parameters.standard
        self._slot = standard.slot_ns
        self._difs = standard.difs_ns
        self._stations = len(state.slots)
        self._everyone = (1 << self._stations) - 1

        self._queues = [list(queue) for queue in state.queues]
        self._slots = list(state.slots)
        self._backoff_from = list(state.backoff_from)
        self._windows = list(state.windows)
        self._busy_until = list(state.busy_until)
        self._error_until = list(state.error_until)
        self._drawn = list(state.drawn)
        self._sent = list(state.sent)
        self._sending = list(state.sending)
        self._immediate = list(state.immediate)
        self._wake = list(state.wake)
        self._air = [_copied(transmission) for transmission in state.air]
        self._busy_from = state.busy_from
        self._events: list[Event] = list(state.events)
        self.outcomes: list[Outcome] = []
        self.counts = Counts()
        least = max(parameters.sensitivity_mw, parameters.preamble_sinr * parameters.noise_mw)
        self._hear = [_mask(power >= least for power in row) & ~(1 << i) for i, row in enumerate(powers)]
        certain = CERTAIN_MARGIN * max(parameters.payload_sinr, parameters.acknowledgement_sinr) * parameters.noise_mw
        self._certain = [_mask(power >= certain for power in row) for row in powers]

    def run(self, frames: Iterable[Frame], until_ns: int) -> None:
        """Process all events before an instant."""
        events = self._events
        events.extend(Event(frame.sent_ns, _SEND, frame.sender, frame.sequence, frame) for frame in frames)
        heapify(events)
        while events and events[0].time_ns < until_ns:
            event = heappop(events)
            now = event.time_ns
            kind = event.kind
            if kind == _SEND:
                self._send(event.subject, now)
            elif kind == _ATTEMPT:
                self._attempt(event.station, now)
            elif kind == _DETECT:
                self._detect(self._transmission_of(event.station), now)
            elif kind == _END:
                self._end(self._transmission_of(event.station), now)
            elif kind == _ACKNOWLEDGE:
                self._transmit_acknowledgement(event.station, event.order, now)
            else:
                self._timeout(event.station, event.order, now)
        if self._air:
            self.counts.busy_ns += until_ns - self._busy_from
            self._busy_from = until_ns

    def state(self) -> ChannelState:
        """Return the state at the end of the window."""
        return ChannelState(
            queues=tuple([tuple(queue) for queue in self._queues]),
            slots=tuple(self._slots),
            backoff_from=tuple(self._backoff_from),
            windows=tuple(self._windows),
            busy_until=tuple(self._busy_until),
            error_until=tuple(self._error_until),
            drawn=tuple(self._drawn),
            sent=tuple(self._sent),
            sending=tuple(self._sending),
            immediate=tuple(self._immediate),
            wake=tuple(self._wake),
            air=tuple([_copied(transmission) for transmission in self._air]),
            events=tuple(sorted(self._events)),
            busy_from=self._busy_from,
        )

    # Queue and backoff

    def _send(self, frame: Frame, now: int) -> None:
        station = frame.sender
        queue = self._queues[station]
        was_empty = not queue
        targets = frame.receivers if self._p.unicast else (_BROADCAST,)
        for target in targets:
            if len(queue) < self._p.queue_length:
                queue.append(Pending(frame, target, 0, False, now))
            else:
                self._lose(frame, target, Result.QUEUE, now)
        if was_empty and queue and not self._sending[station]:
            self._request(station, now)

    def _request(self, station: int, now: int) -> None:
        """Ask for the medium for the first frame of an empty queue."""
        self._count_down(station, now)
        if self._slots[station] == 0:
            if self._busy_until[station] > now:
                self._draw(station, now)
            else:
                self._backoff_from[station] = now + self._difs
                self._immediate[station] = True
        self._wake_at(station, self._due(station))

    def _draw(self, station: int, now: int) -> None:
        """Start a backoff of random length."""
        number = uniform(self._p.seed, station, "backoff", self._drawn[station])
        self._drawn[station] += 1
        self._slots[station] = int(number * (self._windows[station] + 1))
        self._backoff_from[station] = now
        self._immediate[station] = False

    def _count_from(self, station: int) -> int:
        """Return the instant from which the backoff counts, ns."""
        idle_from = max(self._busy_until[station], self._error_until[station]) + self._difs
        return max(self._backoff_from[station], idle_from)

    def _due(self, station: int) -> int:
        """Return the instant at which the backoff ends if the medium stays idle, ns."""
        return self._count_from(station) + self._slots[station] * self._slot

    def _count_down(self, station: int, now: int) -> None:
        """Subtract the idle slots that have passed."""
        begin = self._count_from(station)
        if begin <= now:
            passed = min((now - begin) // self._slot, self._slots[station])
            self._slots[station] -= passed
            self._backoff_from[station] = begin + passed * self._slot

    def _wake_at(self, station: int, time_ns: int) -> None:
        if time_ns < self._wake[station]:
            self._wake[station] = time_ns
            heappush(self._events, Event(time_ns, _ATTEMPT, station, 0, None))

    def _attempt(self, station: int, now: int) -> None:
        """Transmit if the backoff has ended, or look again at its new end."""
        if now != self._wake[station]:
            return
        self._wake[station] = _NEVER
        if self._sending[station] or not self._queues[station]:
            return
        due = self._due(station)
        if due > now:
            self._wake_at(station, due)
            return
        self._transmit_data(station, now)

    # Transmissions

    def _transmit_data(self, station: int, now: int) -> None:
        self._sending[station] = True
        self._slots[station] = 0
        self._immediate[station] = False
        pending = self._queues[station][0]
        self._queues[station][0] = pending._replace(attempts=pending.attempts + 1)
        self.counts.transmissions += 1
        self.counts.repeated += pending.attempts > 0
        end = now + self._p.standard.message_airtime_ns(pending.frame.message_bytes, self._p.rate_mbps)
        self._start(Transmission(station, now, end, self._next(self._sent, station)), now)

    def _transmit_acknowledgement(self, station: int, sender: int, now: int) -> None:
        if self._transmission_of(station) is not None:
            return
        self.counts.acknowledgements += 1
        end = now + self._p.standard.acknowledgement_airtime_ns(self._p.rate_mbps)
        self._start(Transmission(station, now, end, self._next(self._sent, station), acknowledges=sender), now)

    @staticmethod
    def _next(numbers: list[int], station: int) -> int:
        """Return the next number of a station, and count it."""
        number = numbers[station]
        numbers[station] = number + 1
        return number

    def _start(self, new: Transmission, now: int) -> None:
        sender = new.sender
        own = 1 << sender
        self._count_down(sender, now)
        self._busy_until[sender] = max(self._busy_until[sender], new.end_ns)
        self._error_until[sender] = 0
        new.candidates = self._everyone & ~own
        if self._air:
            self._overlap(new, now)
        else:
            self._busy_from = now
        self._air.append(new)
        heappush(self._events, Event(now + self._p.standard.cca_ns, _DETECT, sender, 0, None))
        heappush(self._events, Event(new.end_ns, _END, sender, 0, None))

    def _overlap(self, new: Transmission, now: int) -> None:
        """Enter a transmission that starts while others are on the air."""
        own = 1 << new.sender
        new.alone = False
        occupied = 0
        for other in self._air:
            other.alone = False
            other.overlapping.append(new.sender)
            new.overlapping.append(other.sender)
            other.candidates &= ~own
            other.locked &= ~own
            occupied |= other.locked | 1 << other.sender
        missed = new.candidates & occupied
        new.candidates &= ~occupied
        self._air.append(new)
        for station in _bits(missed):
            self._sense_energy(station, now)
        self._air.pop()

    def _detect(self, transmission: Transmission | None, now: int) -> None:
        """Let the stations that can detect the preamble receive the transmission."""
        sender = transmission.sender
        candidates = transmission.candidates
        if transmission.alone:
            locked = candidates & self._hear[sender]
            transmission.locked = locked
            transmission.candidates = 0
            for station in _bits(locked):
                self._onset(station, transmission.end_ns, now)
                self._error_until[station] = 0
            for station in _bits(candidates & ~locked):
                self._sense_energy(station, now)
            return
        for station in _bits(candidates):
            self._detect_among_others(transmission, station, now)
        transmission.candidates = 0

    def _detect_among_others(self, transmission: Transmission, station: int, now: int) -> None:
        """Lock a station to the strongest of the preambles that it may detect, if it stands out."""
        bit = 1 << station
        power = self._power[transmission.sender][station]
        rivals = [other for other in self._air if other.candidates & bit and other is not transmission]
        if any(self._power[rival.sender][station] > power for rival in rivals):
            return
        others = sum([self._power[other.sender][station] for other in self._air if other is not transmission])
        audible = self._hear[transmission.sender] & bit
        if audible and power >= self._p.preamble_sinr * (self._p.noise_mw + others):
            transmission.locked |= bit
            for rival in rivals:
                rival.candidates &= ~bit
            self._onset(station, transmission.end_ns, now)
            self._error_until[station] = 0
        else:
            self._sense_energy(station, now)

    def _end(self, transmission: Transmission, now: int) -> None:
        """Conclude a transmission at its receivers and at its sender."""
        self._air.remove(transmission)
        if not self._air:
            self.counts.busy_ns += now - self._busy_from
        decoded = self._decoded(transmission)
        for station in _bits(transmission.locked & ~decoded):
            self._error_until[station] = now + self._p.standard.eifs_extra_ns
        if self._air:
            for station in _bits(transmission.locked):
                self._sense_energy(station, now)
        if transmission.acknowledges >= 0:
            if decoded >> transmission.acknowledges & 1:
                self._acknowledged(transmission.acknowledges, now)
        elif self._p.unicast:
            self._end_unicast(transmission, decoded, now)
        else:
            self._end_broadcast(transmission, decoded, now)

    def _decoded(self, transmission: Transmission) -> int:
        """Return the stations that decode the payload."""
        sender = transmission.sender
        if transmission.alone and transmission.locked & ~self._certain[sender] == 0:
            return transmission.locked
        decoded = 0
        for station in _bits(transmission.locked):
            interference = sum([self._power[other][station] for other in transmission.overlapping])
            if self._draw_payload(transmission, station) < self._success(transmission, station, interference):
                decoded |= 1 << station
        return decoded

    def _success(self, transmission: Transmission, station: int, interference_mw: float) -> float:
        """Return the probability that a locked station decodes the payload."""
        sinr = self._power[transmission.sender][station] / (self._p.noise_mw + interference_mw)
        if transmission.acknowledges >= 0:
            return success(ACK_BYTES, sinr / self._p.acknowledgement_sinr)
        frame_bytes = self._queues[transmission.sender][0].frame.message_bytes + OVERHEAD_BYTES
        return success(frame_bytes, sinr / self._p.payload_sinr)

    def _draw_payload(self, transmission: Transmission, station: int) -> float:
        """Return the random number of a transmission at a receiver; it depends on nothing else on the air."""
        sender = transmission.sender
        if transmission.acknowledges >= 0:
            return uniform(self._p.seed, sender, f"acknowledgement {station}", transmission.number)
        return uniform(self._p.seed, sender, f"payload {station}", transmission.number)

    def _end_broadcast(self, transmission: Transmission, decoded: int, now: int) -> None:
        sender = transmission.sender
        frame = self._queues[sender][0].frame
        for receiver in frame.receivers:
            if decoded >> receiver & 1:
                result = Result.DELIVERED
            elif self._weak(transmission, receiver):
                result = Result.WEAK
            else:
                result = Result.COLLISION
            self.outcomes.append(Outcome(frame, receiver, result, now))
        self._queues[sender].pop(0)
        self._release(sender, now)

    def _weak(self, transmission: Transmission, receiver: int) -> bool:
        """Return whether a lost frame would have been lost on an idle channel as well."""
        if not self._hear[transmission.sender] >> receiver & 1:
            return True
        if self._certain[transmission.sender] >> receiver & 1:
            return False
        return self._draw_payload(transmission, receiver) >= self._success(transmission, receiver, 0.0)

    def _end_unicast(self, transmission: Transmission, decoded: int, now: int) -> None:
        sender = transmission.sender
        standard = self._p.standard
        pending = self._queues[sender][0]
        receiver = pending.receiver
        reserved = now + standard.sifs_ns + standard.acknowledgement_airtime_ns(self._p.rate_mbps)
        for station in _bits(decoded & ~(1 << receiver)):
            self._onset(station, reserved, now)
        if decoded >> receiver & 1:
            if not pending.delivered:
                self.outcomes.append(Outcome(pending.frame, receiver, Result.DELIVERED, now))
                self._queues[sender][0] = pending._replace(delivered=True)
            heappush(self._events, Event(now + standard.sifs_ns, _ACKNOWLEDGE, receiver, sender, None))
        timeout = now + standard.sifs_ns + standard.slot_ns + standard.preamble_ns
        heappush(self._events, Event(timeout, _TIMEOUT, sender, pending.attempts, None))

    def _timeout(self, station: int, attempt: int, now: int) -> None:
        """Conclude that no acknowledgement comes, unless one is being received."""
        if not self._sending[station] or self._transmission_of(station) is not None:
            return
        pending = self._queues[station][0]
        if pending.attempts != attempt:
            return
        receiving = [other.end_ns for other in self._air if other.locked >> station & 1]
        if receiving:
            # An acknowledgement ends before the timeouts of its instant.
            heappush(self._events, Event(receiving[0], _TIMEOUT, station, attempt, None))
            return
        if attempt < self._p.attempts:
            self._windows[station] = min(2 * self._windows[station] + 1, self._p.standard.cw_max)
            self._back_off(station, now)
            return
        self._queues[station].pop(0)
        if not pending.delivered:
            self.outcomes.append(Outcome(pending.frame, pending.receiver, Result.RETRIES, now))
        self._release(station, now)

    def _acknowledged(self, station: int, now: int) -> None:
        if self._sending[station]:
            self._queues[station].pop(0)
            self._release(station, now)

    def _release(self, station: int, now: int) -> None:
        """End a frame: smallest window, and a backoff before the next frame."""
        self._windows[station] = self._p.standard.cw_min
        self._back_off(station, now)

    def _back_off(self, station: int, now: int) -> None:
        self._sending[station] = False
        self._draw(station, now)
        if self._queues[station]:
            self._wake_at(station, self._due(station))

    def _lose(self, frame: Frame, target: int, result: Result, now: int) -> None:
        receivers = frame.receivers if target == _BROADCAST else (target,)
        self.outcomes.extend(Outcome(frame, receiver, result, now) for receiver in receivers)

    # Carrier sense

    def _onset(self, station: int, until_ns: int, now: int) -> None:
        """Freeze the backoff of a station: the medium is busy until an instant."""
        self._count_down(station, now)
        if until_ns > self._busy_until[station]:
            self._busy_until[station] = until_ns
        if self._immediate[station] and self._p.interrupted_wait_draws:
            self._draw(station, now)

    def _sense_energy(self, station: int, now: int) -> None:
        """Keep the medium busy as long as the power on the air is above the threshold."""
        power = 0.0
        for other in sorted(self._air, key=_ends_last):
            if other.sender == station:
                continue
            power += self._power[other.sender][station]
            if power >= self._p.carrier_sense_mw:
                self._onset(station, other.end_ns, now)
                return

    def _transmission_of(self, station: int) -> Transmission | None:
        for transmission in self._air:
            if transmission.sender == station:
                return transmission
        return None


def advance(
    parameters: ChannelParameters,
    state: ChannelState,
    powers: Sequence[Sequence[float]],
    frames: Iterable[Frame],
    until_ns: int,
) -> tuple[ChannelState, list[Outcome], Counts]:
    """Return the channel at an instant, with what was decided since the state's: outcomes and counts.

    Args:
        parameters: Settings of the channel.
        state: The channel at the end of the last window.
        powers: Received power, mW, of each sender (row) at each station (column).
        frames: Frames sent from the state's instant on, in any order, also after `until_ns`.
        until_ns: End of the window; events at this instant belong to the next one.
    """
    window = Window(parameters, state, powers)
    window.run(frames, until_ns)
    return window.state(), window.outcomes, window.counts


def _ends_last(transmission: Transmission) -> tuple[int, int]:
    return -transmission.end_ns, transmission.sender


def _copied(transmission: Transmission) -> Transmission:
    return Transmission(
        transmission.sender,
        transmission.start_ns,
        transmission.end_ns,
        transmission.number,
        transmission.acknowledges,
        transmission.alone,
        transmission.candidates,
        transmission.locked,
        list(transmission.overlapping),
    )


def _mask(flags: Iterable[bool]) -> int:
    """Return the bit mask of the places that are true."""
    return sum([1 << place for place, flag in enumerate(flags) if flag])


def _bits(mask: int) -> Iterable[int]:
    """Return the places of a mask's bits, ascending."""
    while mask:
        low = mask & -mask
        yield low.bit_length() - 1
        mask ^= low
