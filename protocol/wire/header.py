"""The header of a message, read without the rest: enough to recognise a message that was received before.

A flood of repeated messages is refused on the receiving thread, without decoding the rest or waking the working thread.
Only messages that the admission would refuse later in any case are refused here, so a process that follows the protocol
loses nothing, and a lockstep run stays the same bit for bit.
"""

import struct
from dataclasses import dataclass

import msgpack

from protocol.wire.codec import VERSION, class_of, field_names
from protocol.wire.messages import BUNDLES, KINDS, Message, MessageError
from protocol.wire.names import is_name

# Bytes that hold the header of any message of a run: a name, a kind and up to six integers.
_ENOUGH = 128

# Fields of every message: sender, incarnation, sequence, tick.
_COMMON = 4

Place = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Header:
    """The beginning of a message.

    Attributes:
        place: Value that grows from each message of its kind under a key to the next; None for kinds of which only
            the sequence number does.
    """

    kind: str
    sender: str
    incarnation: int
    sequence: int
    tick: int
    place: Place | None


def place_of(message: Message) -> Place | None:
    """Return the place of a message, as its header has it."""
    return _place(message.kind, message.tick, getattr(message, _detail(message.kind), 0))


def header_of(data: bytes) -> Header | None:
    """Return the header of a message; None if only decoding the whole message can say what is wrong with it.

    Raises: MessageError: no message of this version begins so.
    """
    if not data:
        raise MessageError("malformed", "empty message")
    if data[0] != VERSION:
        raise MessageError("wrong_version", f"protocol version {data[0]}, expected {VERSION}")
    unpacker = msgpack.Unpacker(raw=False, max_buffer_size=_ENOUGH)  # which also bounds the sizes it announces
    unpacker.feed(memoryview(data)[1:_ENOUGH])
    try:
        if unpacker.read_array_header() < 1 + _COMMON:
            return None
        kind, sender, incarnation, sequence, tick = (unpacker.unpack() for _ in range(1 + _COMMON))
        further = [unpacker.unpack() for _ in range(_to_detail(kind))]
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


def _detail(kind: str) -> str:
    """Return the field of its own by which a kind is ordered, or an empty text."""
    route = class_of(kind).route
    return route.falls or (route.grows if route.grows not in ("sequence", "tick") else "")


def _to_detail(kind: object) -> int:
    """Return how many fields to read after the common ones."""
    if not (isinstance(kind, str) and (kind in KINDS or kind in BUNDLES) and _detail(kind)):
        return 0
    return field_names(kind).index(_detail(kind)) + 1 - _COMMON


def _place(kind: str, tick: int, detail: int) -> Place | None:
    grows = class_of(kind).route.grows if kind in KINDS or kind in BUNDLES else "sequence"
    if grows == "sequence":
        return None
    return (tick, -detail) if grows == "tick" else (detail, 0)
