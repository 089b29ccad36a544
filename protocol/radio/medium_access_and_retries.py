"""Event model of one shared half-duplex 802.11 channel.

Stations are numbered from 0. Times are integers, ns, of one common clock. docs/record/radio.md describes
the model and states what is simplified. A frame passes these events, each at an instant of one queue:

    SEND         joins the queue of its station; the first of a queue asks for the medium  --> ATTEMPT
    ATTEMPT      its backoff has ended: it is on the air; else again at the new end        --> DETECT, END
    DETECT       stations lock to it by its preamble, the strongest one if several overlap
    END          locked stations decode it or not; a broadcast is decided here,
                 a unicast frame waits for its acknowledgement                             --> ACKNOWLEDGE, TIMEOUT
    ACKNOWLEDGE  its receiver puts the acknowledgement on the air, whatever the medium     --> DETECT, END
    TIMEOUT      none has come: a longer backoff, or lost after the last attempt           --> ATTEMPT

Sets of stations are integers with a bit for each. Steps that no other event can come between are done
at once (`_is_next`), with the same result.
"""

from collections.abc import Iterable
from heapq import heapify, heappop, heappush

from transport.protocol.radio.channel_settings_and_state import (
    ACKNOWLEDGE,
    ATTEMPT,
    DETECT,
    END,
    SEND,
    TIMEOUT,
    ChannelCounts,
    ChannelParameters,
    ChannelState,
    Event,
    Thresholds,
)
from transport.protocol.radio.frames import (
    Frame,
    FrameOutcome,
    FrameResult,
    Powers,
    Transmission,
    enter,
    members,
    sensed_until,
)
from transport.protocol.radio.payload_decoding import Decoding
from transport.protocol.radio.standards_80211 import ACK_BYTES, OVERHEAD_BYTES
from transport.protocol.radio.station_queue import BROADCAST, NEVER, Pending, Station


class _Window:
    """The channel during one window of time."""

    def __init__(
        self,
        parameters: ChannelParameters,
        thresholds: Thresholds,
        state: ChannelState,
        powers: Powers,
        *,
        near: bool,
    ) -> None:
        self._parameters = parameters
        self._standard = parameters.standard
        self._powers = powers
        self.stations = [station.copy() for station in state.stations]
        self.air = [transmission.copy() for transmission in state.air]
        self.events = list(state.events)
        self.outcomes: list[FrameOutcome] = []
        self.counts = ChannelCounts()

        self._until_ns = state.time_ns  # end of the window
        self._busy_from = state.time_ns
        self._everyone = (1 << len(self.stations)) - 1
        self._seed = parameters.seed
        self._redraw_seed = parameters.seed if parameters.interrupted_wait_draws else None

        self._decoding = Decoding(parameters, thresholds, powers, len(self.stations), near=near)
        self._is_shared_by_all = near and not parameters.unicast

    def run(self, frames: Iterable[Frame], until_ns: int) -> None:
        """Process all events before an instant."""
        self._until_ns = until_ns
        events = self.events
        events.extend(
            [Event(frame.sent_ns, SEND, frame.sender, frame.sequence, frame) for frame in frames]
        )
        heapify(events)

        while events and events[0].time_ns < until_ns:
            event = heappop(events)
            now = event.time_ns
            if event.kind == ATTEMPT:
                self._attempt(self.stations[event.station], now)
            elif event.kind == DETECT:
                self._detect(self._transmission_of(event.station), now)
            elif event.kind == END:
                self._end(self._transmission_of(event.station), now)
            elif event.kind == ACKNOWLEDGE:
                self._acknowledge(self.stations[event.station], event.number, now)
            elif event.kind == TIMEOUT:
                self._time_out(self.stations[event.station], event.number, now)
            elif event.frame is not None:
                self._send(self.stations[event.station], event.frame, now)

        if self.air:
            self.counts.busy_ns += until_ns - self._busy_from

    # Sends and attempts

    def _send(self, station: Station, frame: Frame, now: int) -> None:
        """Take a frame into the queue of its sender, and ask for the medium if it is the first."""
        was_idle = not station.queue and not station.sending
        if was_idle:
            station.request(self._seed, now)
            if self._is_shared_by_all and self._carry_alone(station, frame):
                return

        is_unicast = self._parameters.unicast and frame.receivers
        for receiver in frame.receivers if is_unicast else (BROADCAST,):
            if not station.enqueue(Pending(frame, receiver), self._parameters.queue_length):
                lost = frame.receivers if receiver == BROADCAST else (receiver,)
                self.outcomes.extend(
                    [FrameOutcome(frame, loser, FrameResult.QUEUE, now) for loser in lost]
                )
        if was_idle:
            self._transmit_when_due(station)

    def _carry_alone(self, sender: Station, frame: Frame) -> bool:
        """Carry a broadcast that all stations decode, if nothing else happens until its end.

        The result is that of `_transmit`, `_detect` and `_end`, in fewer steps.
        """
        begin = sender.due()
        frame_bytes = frame.message_bytes + OVERHEAD_BYTES
        airtime_ns = self._standard.airtime_ns(frame_bytes, self._parameters.rate_mbps)
        end = begin + airtime_ns
        if self.air or not self._is_next(end):
            return False

        self.counts.transmissions += 1
        self.counts.busy_ns += airtime_ns
        detected = begin + self._standard.cca_ns
        for station in self.stations:
            station.error_until = 0
            if station is not sender:
                station.sense(end, detected, redraw_seed=self._redraw_seed)

        sender.transmissions += 1
        sender.busy_until = end
        sender.window = self._standard.cw_min
        sender.draw_backoff(self._seed, end)
        self.outcomes += [
            FrameOutcome(frame, receiver, FrameResult.DELIVERED, end)
            for receiver in frame.receivers
        ]
        return True

    def _transmit_when_due(self, station: Station) -> None:
        """Transmit at the end of the backoff, at once if nothing happens until then."""
        due = station.due()
        if self._is_next(due):
            self._transmit(station, due)
        else:
            self._schedule_attempt(station)

    def _schedule_attempt(self, station: Station) -> None:
        due = station.due()
        if due < station.attempt_ns:
            station.attempt_ns = due
            heappush(self.events, Event(due, ATTEMPT, station.number))

    def _attempt(self, station: Station, now: int) -> None:
        """Transmit if the backoff has ended; try again at its new end if it was frozen."""
        if now != station.attempt_ns:
            return
        station.attempt_ns = NEVER
        if station.sending or not station.queue:
            return
        if station.due() > now:
            self._schedule_attempt(station)
            return
        self._transmit(station, now)

    def _transmit(self, station: Station, now: int) -> None:
        """Put the first frame of a queue on the air."""
        pending = station.queue[0]
        station.queue[0] = pending._replace(attempts=pending.attempts + 1)
        station.sending = True
        station.slots = 0
        station.waits_without_backoff = False

        self.counts.transmissions += 1
        if pending.attempts > 0:
            self.counts.repetitions += 1

        frame_bytes = pending.frame.message_bytes + OVERHEAD_BYTES
        end = now + self._standard.airtime_ns(frame_bytes, self._parameters.rate_mbps)
        self._start(
            Transmission(station.number, station.next_transmission(), now, end, frame_bytes), now
        )

    def _acknowledge(self, station: Station, sender: int, now: int) -> None:
        """Acknowledge a frame, whatever the medium: SIFS is shorter than all other waits."""
        self.counts.acknowledgements += 1
        end = now + self._standard.acknowledgement_airtime_ns(self._parameters.rate_mbps)
        self._start(
            Transmission(station.number, station.next_transmission(), now, end, ACK_BYTES, sender),
            now,
        )

    def _start(self, new: Transmission, now: int) -> None:
        sender = self.stations[new.sender]
        sender.count_down(now)
        sender.busy_until = max(sender.busy_until, new.end_ns)
        sender.error_until = 0

        new.candidates = self._everyone & ~(1 << new.sender)
        if not self.air:
            self._busy_from = now
            missed = 0
        else:
            missed = enter(new, self.air)
        self.air.append(new)
        for number in members(missed):
            self._sense_power(number, now)

        # Nothing else happens until the end: preamble and end are decided at once.
        detected_ns = now + self._standard.cca_ns
        if not new.overlaps and self._is_next(new.end_ns):
            self._detect(new, detected_ns)
            self._end(new, new.end_ns)
            return
        heappush(self.events, Event(detected_ns, DETECT, new.sender))
        heappush(self.events, Event(new.end_ns, END, new.sender))

    def _is_next(self, time_ns: int) -> bool:
        """Return whether an instant is in this window, and before all events that are known."""
        is_before_all = not self.events or time_ns < self.events[0].time_ns
        return is_before_all and time_ns < self._until_ns

    # Preambles and carrier sense

    def _detect(self, transmission: Transmission, now: int) -> None:
        """Lock stations to a transmission whose preamble they detect."""
        candidates = transmission.candidates
        if transmission.overlaps:
            for number in members(candidates):
                self._detect_among_others(transmission, number, now)
        else:
            locked = candidates & self._decoding.detecting[transmission.sender]
            self._lock(transmission, locked, now)
            for number in members(candidates & ~locked):
                self._sense_power(number, now)
        transmission.candidates = 0

    def _detect_among_others(self, transmission: Transmission, number: int, now: int) -> None:
        """Lock a station to the strongest of the preambles that it may detect, if it stands out."""
        station = 1 << number
        powers = self._powers
        power = powers[transmission.sender][number]
        rivals = [
            other for other in self.air if other.candidates & station and other is not transmission
        ]
        if any(powers[rival.sender][number] > power for rival in rivals):
            return  # the stronger one is decided at its own detection

        others_mw = sum(
            [powers[other.sender][number] for other in self.air if other is not transmission]
        )
        stands_out = power >= self._parameters.preamble_ratio * (
            self._parameters.noise_mw + others_mw
        )
        if stands_out and self._decoding.detecting[transmission.sender] & station:
            for rival in rivals:
                rival.candidates &= ~station
            self._lock(transmission, station, now)
        else:
            self._sense_power(number, now)

    def _lock(self, transmission: Transmission, locked: int, now: int) -> None:
        transmission.locked |= locked
        for number in members(locked):
            station = self.stations[number]
            station.sense(transmission.end_ns, now, redraw_seed=self._redraw_seed)
            station.error_until = 0

    def _sense_power(self, number: int, now: int) -> None:
        """Keep the medium busy as long as the total power at a station is above the threshold."""
        until = sensed_until(self.air, number, self._powers, self._parameters.carrier_sense_mw)
        if until > now:
            self.stations[number].sense(until, now, redraw_seed=self._redraw_seed)

    # Ends of transmissions

    def _end(self, transmission: Transmission, now: int) -> None:
        """Conclude a transmission at its receivers, then at its sender."""
        self.air.remove(transmission)
        if not self.air:
            self.counts.busy_ns += now - self._busy_from

        decoded = self._decoding.decoded(transmission)
        for number in members(transmission.locked & ~decoded):
            self.stations[number].error_until = now + self._standard.eifs_extra_ns
        if self.air:
            for number in members(transmission.locked):
                self._sense_power(number, now)

        sender = self.stations[transmission.sender]
        if transmission.acknowledged >= 0:
            if decoded >> transmission.acknowledged & 1:
                self._acknowledged(self.stations[transmission.acknowledged], now)
        elif sender.queue[0].receiver == BROADCAST:
            self._end_broadcast(sender, transmission, decoded, now)
        else:
            self._end_unicast(sender, decoded, now)

    def _end_broadcast(
        self, sender: Station, transmission: Transmission, decoded: int, now: int
    ) -> None:
        frame = sender.queue.pop(0).frame
        for receiver in frame.receivers:
            result = FrameResult.DELIVERED
            if not decoded >> receiver & 1:
                is_weak = self._decoding.is_weak(transmission, receiver)
                result = FrameResult.WEAK if is_weak else FrameResult.COLLISION
            self.outcomes.append(FrameOutcome(frame, receiver, result, now))
        self._release(sender, now)

    def _end_unicast(self, sender: Station, decoded: int, now: int) -> None:
        """Let the receiver acknowledge; all others that decoded the frame keep quiet meanwhile."""
        standard = self._standard
        pending = sender.queue[0]
        receiver = 1 << pending.receiver
        reserved_until = (
            now + standard.sifs_ns + standard.acknowledgement_airtime_ns(self._parameters.rate_mbps)
        )
        for number in members(decoded & ~receiver):
            self.stations[number].sense(reserved_until, now, redraw_seed=self._redraw_seed)

        if decoded & receiver:
            if not pending.delivered:
                self.outcomes.append(
                    FrameOutcome(pending.frame, pending.receiver, FrameResult.DELIVERED, now)
                )
                sender.queue[0] = pending._replace(delivered=True)
            acknowledgement = Event(
                now + standard.sifs_ns, ACKNOWLEDGE, pending.receiver, sender.number
            )
            heappush(self.events, acknowledgement)

        timeout_ns = now + standard.sifs_ns + standard.slot_ns + standard.preamble_ns
        heappush(self.events, Event(timeout_ns, TIMEOUT, sender.number, pending.attempts))

    def _time_out(self, station: Station, attempt: int, now: int) -> None:
        """Conclude that no acknowledgement comes, unless one may be on its way."""
        if not station.sending or station.queue[0].attempts != attempt:
            return
        pending = station.queue[0]
        receiving = [other.end_ns for other in self.air if other.locked >> station.number & 1]
        if receiving:
            heappush(self.events, Event(receiving[0], TIMEOUT, station.number, attempt))
            return
        if attempt < self._parameters.attempts:
            station.window = min(2 * station.window + 1, self._standard.cw_max)
            self._back_off(station, now)
            return
        if not pending.delivered:
            self.outcomes.append(
                FrameOutcome(pending.frame, pending.receiver, FrameResult.RETRIES, now)
            )
        station.queue.pop(0)
        self._release(station, now)

    def _acknowledged(self, station: Station, now: int) -> None:
        if station.sending:
            station.queue.pop(0)
            self._release(station, now)

    def _release(self, station: Station, now: int) -> None:
        """End a frame: the smallest window again, and a backoff before the next frame."""
        station.window = self._standard.cw_min
        self._back_off(station, now)

    def _back_off(self, station: Station, now: int) -> None:
        station.sending = False
        station.draw_backoff(self._seed, now)
        if station.queue:
            self._schedule_attempt(station)

    def _transmission_of(self, number: int) -> Transmission:
        """Return the transmission of a station that is on the air; a station has one at most."""
        for transmission in self.air:
            if transmission.sender == number:
                return transmission
        raise LookupError(f"station {number}: expected a transmission on the air, got none")


class Channel:
    """One channel with its settings; `advance` has no memory of its own."""

    def __init__(self, parameters: ChannelParameters) -> None:
        self.parameters = parameters
        self._thresholds = parameters.thresholds()

    def is_near(self, power_mw: float) -> bool:
        """Return whether a station certainly decodes a sender on an idle channel."""
        thresholds = self._thresholds
        return power_mw >= max(thresholds.detected_mw, thresholds.certain_mw)

    def advance(
        self,
        state: ChannelState,
        powers: Powers,
        frames: Iterable[Frame],
        until_ns: int,
        *,
        near: bool = False,
    ) -> tuple[ChannelState, list[FrameOutcome], ChannelCounts]:
        """Return the channel at a later instant, with what was decided meanwhile.

        Args:
            state: The channel at the end of the last window; it is not changed.
            powers: Received power, mW, of each sender (row) at each station (column) in the window.
            frames: Frames sent from the state's instant on, in any order, also after `until_ns`.
            until_ns: End of the window; events at this instant belong to the next one.
            near: Whether the powers of all pairs are known to be near (`is_near`). They are then read
                only where transmissions overlap. The result is the same.

        Returns: The state at `until_ns`, outcomes in the order of their instants, and counts. Each
            frame has one outcome for each of its receivers, in this window or a later one.
        """
        window = _Window(self.parameters, self._thresholds, state, powers, near=near)
        window.run(frames, until_ns)
        later = ChannelState(
            tuple(window.stations), tuple(window.air), tuple(sorted(window.events)), until_ns
        )
        return later, window.outcomes, window.counts
