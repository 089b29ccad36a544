"""Frames that stations send, and their fate at each receiver."""

from enum import IntEnum
from typing import NamedTuple


class Result(IntEnum):
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


class Outcome(NamedTuple):
    """Fate of a frame at one receiver, and the instant of the arrival or loss."""

    frame: Frame
    receiver: int
    result: Result
    time_ns: int

    @property
    def delay_ns(self) -> int:
        """Time from the send to the arrival or loss, ns."""
        return self.time_ns - self.frame.sent_ns
