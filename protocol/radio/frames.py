"""Frames that stations send: their transmissions on the air, and their fate at each receiver.

Which transmission a station locks to, and the power that it senses. Sets of stations are bit masks:
station 3 is the bit of value 8.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import lru_cache
from typing import NamedTuple

_SETS_KEPT = 4096  # saves only time

Powers = Sequence[Sequence[float]]


class FrameResult(IntEnum):
    """Fate of a frame at one receiver; a loss is minus this number in `Airtime.arrivals`."""

    DELIVERED = 0
    COLLISION = 1  # another transmission interfered, or the receiver itself transmitted
    WEAK = 2  # too weak for the receiver: lost on an idle channel as well
    QUEUE = 3  # the queue of the sender was full
    RETRIES = 4  # no acknowledgement after the last attempt
    REPLACED = 5  # never sent: a newer one took its place before its slot


class Frame(NamedTuple):
    """One message for the air: broadcast to all receivers, or unicast to each of them in turn."""

    sent_ns: int  # instant at which the sender queues the frame
    sender: int
    sequence: int  # number among the frames of the sender
    message_bytes: int
    receivers: tuple[int, ...]


class FrameOutcome(NamedTuple):
    """Fate of a frame at one receiver, and the instant of the arrival or loss."""

    frame: Frame
    receiver: int
    result: FrameResult
    time_ns: int

    @property
    def delay_ns(self) -> int:
        """Time from the send to the arrival or loss, ns."""
        return self.time_ns - self.frame.sent_ns


class Overlap(NamedTuple):
    """Another transmission that overlaps in time."""

    sender: int
    start_ns: int
    end_ns: int


@dataclass(slots=True)
class Transmission:
    """A data frame or an acknowledgement on the air."""

    sender: int
    number: int  # among the transmissions of the sender
    start_ns: int
    end_ns: int
    frame_bytes: int
    acknowledged: int = -1  # station whose frame it acknowledges; -1: a data frame
    candidates: int = 0  # stations that may still detect its preamble
    locked: int = 0  # stations that receive it
    overlaps: list[Overlap] = field(default_factory=list)

    def copy(self) -> "Transmission":
        """Return a transmission that does not share its overlaps."""
        return Transmission(
            self.sender,
            self.number,
            self.start_ns,
            self.end_ns,
            self.frame_bytes,
            self.acknowledged,
            self.candidates,
            self.locked,
            self.overlaps.copy(),
        )

    def overlap(self) -> Overlap:
        """Return the transmission as another one sees it."""
        return Overlap(self.sender, self.start_ns, self.end_ns)


def enter(new: Transmission, air: Iterable[Transmission]) -> int:
    """Enter a transmission among those on the air, and return the stations that miss its preamble.

    A sender stops receiving. A station that transmits, or is locked to another transmission, cannot
    detect the new one.
    """
    sender = 1 << new.sender
    occupied = 0
    for other in air:
        other.overlaps.append(new.overlap())
        new.overlaps.append(other.overlap())
        other.candidates &= ~sender
        other.locked &= ~sender
        occupied |= other.locked | 1 << other.sender
    missed = new.candidates & occupied
    new.candidates &= ~occupied
    return missed


def sensed_until(
    air: Iterable[Transmission], station: int, powers: Powers, threshold_mw: float
) -> int:
    """Return until when the total power at a station is above a threshold, ns; 0: it is not."""
    total_mw = 0.0
    for transmission in sorted(air, key=_latest_end_first):
        if transmission.sender == station:
            continue
        total_mw += powers[transmission.sender][station]
        if total_mw >= threshold_mw:
            return transmission.end_ns
    return 0


def _latest_end_first(transmission: Transmission) -> tuple[int, int]:
    return -transmission.end_ns, transmission.sender


def at_least(threshold_mw: float, powers_mw: Iterable[float]) -> int:
    """Return the set of the stations whose power is not below a threshold."""
    return sum([1 << place for place, power in enumerate(powers_mw) if power >= threshold_mw])


@lru_cache(maxsize=_SETS_KEPT)
def members(mask: int) -> tuple[int, ...]:
    """Return the stations of a set in ascending order."""
    found = []
    while mask:
        lowest = mask & -mask
        found.append(lowest.bit_length() - 1)
        mask ^= lowest
    return tuple(found)
