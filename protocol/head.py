"""The head of a message, read without the rest: enough to see that it has been said before.

Whoever floods a process with what it has heard already is refused on the thread that receives, unread; the thread that
works is not even woken. Only what the gate would refuse later in any case is refused here, so nobody who follows the
protocol loses anything, and a lockstep run stays the same bit for bit.
"""

import struct
from dataclasses import dataclass

import msgpack

from protocol.codec import VERSION
from protocol.messages import Measurement, MessageError, Plan, StepReport, Tick, Truth, is_name

# Bytes that hold the head of any message a process of a run sends: a name, a kind and up to six integers.
_ENOUGH = 128

# Kinds of which each tick brings one under a key, once what they negotiate is settled.
ONCE_A_TICK = (Tick.kind, Measurement.kind, Plan.kind, StepReport.kind, Truth.kind)

# What follows the head of a plan, up to which of the tick's plans it is.
_OF_PLAN = ("agent", "start_tick", "negotiation")


@dataclass(frozen=True, slots=True)
class Head:
    """What every message begins with.

    Attributes:
        negotiation: A plan's; 0 for other kinds.
    """

    kind: str
    sender: str
    incarnation: int
    sequence: int
    tick: int
    negotiation: int

    @property
    def place(self) -> tuple[int, int] | None:
        """What grows from each message under a key to the next, of kinds that each tick brings."""
        return (self.tick, -self.negotiation) if self.kind in ONCE_A_TICK else None


def head_of(data: bytes) -> Head | None:
    """The head of a message; None where it takes reading the whole to say what is wrong with it.

    Args:
        data: The message.
    Raises: MessageError: no message of this version begins so.
    """
    if not data:
        raise MessageError("malformed", "empty message")
    if data[0] != VERSION:
        raise MessageError("wrong_version", f"protocol version {data[0]}, expected {VERSION}")
    unpacker = msgpack.Unpacker(raw=False)
    unpacker.feed(memoryview(data)[1:_ENOUGH])
    try:
        if unpacker.read_array_header() < 5:
            return None
        kind, sender, incarnation, sequence, tick = (unpacker.unpack() for _ in range(5))
        negotiation = [unpacker.unpack() for _ in _OF_PLAN][-1] if kind == Plan.kind else 0
    except msgpack.OutOfData:
        return None
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException, struct.error) as error:
        raise MessageError("malformed", f"not msgpack ({type(error).__name__})") from error
    if not (is_name(sender) and isinstance(kind, str)):
        return None
    if not all(type(number) is int for number in (incarnation, sequence, tick, negotiation)):
        return None
    return Head(kind, sender, incarnation, sequence, tick, negotiation)
