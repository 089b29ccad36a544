"""One station: its queue, its carrier sense and its backoff.

Source: distributed coordination function, IEEE 802.11-2020, 10.3.4.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

from transport.protocol.radio.frames import Frame
from transport.protocol.radio.radio_random_numbers import uniform
from transport.protocol.radio.standards_80211 import Standard

BROADCAST = -1
NEVER = 2**62


class Pending(NamedTuple):
    """A frame in the queue, for one receiver if unicast."""

    frame: Frame
    receiver: int  # BROADCAST: all receivers of the frame
    attempts: int = 0  # transmissions so far
    delivered: bool = False  # the receiver has the frame; its acknowledgement was lost


@dataclass(slots=True)
class Station:
    """State of one station. Times are instants, ns.

    Invariant: `slots` idle slots remain to be counted from `count_from()` on.
    """

    number: int
    slot_ns: int
    difs_ns: int
    window: int  # contention window: a backoff has 0 to `window` slots
    queue: list[Pending] = field(default_factory=list)  # the frame on the air is the first
    slots: int = 0
    backoff_from: int = 0  # no idle slot counts before
    busy_until: int = 0  # end of own and sensed transmissions, and of reserved time
    # A frame could not be decoded: the medium counts as busy for an acknowledgement (EIFS).
    error_until: int = 0
    sending: bool = False  # a frame is on the air or waits for its acknowledgement
    # The frame met an idle medium, which must stay idle for DIFS.
    waits_without_backoff: bool = False
    attempt_ns: int = NEVER  # instant of the next attempt in the events of the channel
    backoffs: int = 0  # backoffs drawn so far
    transmissions: int = 0  # numbers of transmissions used so far

    @classmethod
    def idle(cls, number: int, standard: Standard) -> "Station":
        """Return a station that has been idle."""
        return cls(number, standard.slot_ns, standard.difs_ns, standard.cw_min)

    def copy(self) -> "Station":
        """Return a station that does not share its queue."""
        return Station(
            self.number,
            self.slot_ns,
            self.difs_ns,
            self.window,
            self.queue.copy(),
            self.slots,
            self.backoff_from,
            self.busy_until,
            self.error_until,
            self.sending,
            self.waits_without_backoff,
            self.attempt_ns,
            self.backoffs,
            self.transmissions,
        )

    def enqueue(self, newest: Pending, most: int) -> bool:
        """Append a frame unless the queue is full; return whether it was appended.

        A full queue keeps its frames and drops the newest.

        Args:
            newest: The frame.
            most: Length of a full queue, with the frame on the air.
        """
        if len(self.queue) >= most:
            return False
        self.queue.append(newest)
        return True

    def count_from(self) -> int:
        """Return the instant from which idle slots count: DIFS, or EIFS, behind the activity."""
        busy_until = self.busy_until
        if self.error_until > busy_until:
            busy_until = self.error_until
        idle_from = busy_until + self.difs_ns
        return idle_from if idle_from > self.backoff_from else self.backoff_from

    def due(self) -> int:
        """Return the instant at which the backoff ends if the medium stays idle."""
        return self.count_from() + self.slots * self.slot_ns

    def count_down(self, now: int) -> None:
        """Subtract the idle slots that have passed."""
        begin = self.count_from()
        if begin > now:
            return
        passed = (now - begin) // self.slot_ns
        if passed > self.slots:
            passed = self.slots
        self.slots -= passed
        self.backoff_from = begin + passed * self.slot_ns

    def sense(self, until_ns: int, now: int, *, redraw_seed: int | None) -> None:
        """Freeze the backoff: the medium is busy until an instant.

        Args:
            until_ns: End of the activity.
            now: Start of the activity, as sensed.
            redraw_seed: Seed of the backoff of a frame whose wait of DIFS is interrupted; None: it
                keeps none.
        """
        if self.slots:
            self.count_down(now)
        if until_ns > self.busy_until:
            self.busy_until = until_ns
        if self.waits_without_backoff and redraw_seed is not None:
            self.draw_backoff(redraw_seed, now)

    def request(self, seed: int, now: int) -> None:
        """Ask for the medium for the first frame of an empty queue.

        A running backoff goes on. Without one, a frame that meets an idle medium is sent after DIFS,
        and one that meets a busy medium after a random backoff.
        """
        self.count_down(now)
        if self.slots > 0:
            return
        if self.busy_until > now:
            self.draw_backoff(seed, now)
        else:
            self.backoff_from = now + self.difs_ns
            self.waits_without_backoff = True

    def draw_backoff(self, seed: int, now: int) -> None:
        """Start a backoff of random length."""
        random = uniform(seed, self.number, "backoff", self.backoffs)
        self.backoffs += 1
        self.slots = int(random * (self.window + 1))
        self.backoff_from = now
        self.waits_without_backoff = False

    def next_transmission(self) -> int:
        """Return the number of a new transmission."""
        number = self.transmissions
        self.transmissions += 1
        return number
