"""The head of a message, read without the rest: enough to see that it has been said before.

Whoever floods a process with what it has heard already is refused on the thread that receives, unread; the thread that
works is not even woken. Only what the gate would refuse later in any case is refused here, so nobody who follows the
protocol loses anything, and a lockstep run stays the same bit for bit.
"""

import struct
from dataclasses import dataclass

import msgpack

from protocol.wire.codec import VERSION
from protocol.wire.messages import (
    Measurement,
    Message,
    MessageError,
    Plan,
    PlantState,
    Roster,
    StepReport,
    Tick,
    is_name,
)

# Bytes that hold the head of any message a process of a run sends: a name, a kind and up to six integers.
_ENOUGH = 128

# Kinds of which each tick brings one under a key, once what they negotiate is settled.
ONCE_A_TICK = (Tick.kind, Measurement.kind, Plan.kind, StepReport.kind, PlantState.kind)

# How much of what follows tells where among its kind a message belongs, the last of which does: a plan's negotiation, a
# roster's version.
_TO_PLACE = {Plan.kind: 3, Roster.kind: 1}

Place = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Header:
    """What every message begins with.

    Attributes:
        place: What grows from each message of its kind under a key to the next; None for kinds of which only the
            number does.
    """

    kind: str
    sender: str
    incarnation: int
    sequence: int
    tick: int
    place: Place | None


def place_of(message: Message) -> Place | None:
    """The place of a message, as its head tells it."""
    match message:
        case Plan():
            return _place(message.kind, message.tick, message.negotiation)
        case Roster():
            return _place(message.kind, message.tick, message.version)
    return _place(message.kind, message.tick, 0)


def header_of(data: bytes) -> Header | None:
    """The head of a message; None where it takes reading the whole to say what is wrong with it.

    Args:
        data: The message.
    Raises: MessageError: no message of this version begins so.
    """
    if not data:
        raise MessageError("malformed", "empty message")
    if data[0] != VERSION:
        raise MessageError("wrong_version", f"protocol version {data[0]}, expected {VERSION}")
    unpacker = msgpack.Unpacker(raw=False, max_buffer_size=_ENOUGH)  # which bounds what a header may announce, too
    unpacker.feed(memoryview(data)[1:_ENOUGH])
    try:
        if unpacker.read_array_header() < 5:
            return None
        kind, sender, incarnation, sequence, tick = (unpacker.unpack() for _ in range(5))
        further = [unpacker.unpack() for _ in range(_TO_PLACE.get(kind, 0))] if isinstance(kind, str) else []
    except msgpack.OutOfData:
        return None
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException, struct.error) as error:
        raise MessageError("malformed", f"not msgpack ({type(error).__name__})") from error
    if not (is_name(sender) and isinstance(kind, str)):
        return None
    detail = further[-1] if further else 0
    if not all(type(number) is int for number in (incarnation, sequence, tick, detail)):
        return None
    return Header(kind, sender, incarnation, sequence, tick, _place(kind, tick, detail))


def _place(kind: str, tick: int, detail: int) -> Place | None:
    if kind == Roster.kind:
        return detail, 0
    return (tick, -detail) if kind in ONCE_A_TICK else None
