"""Messages as bytes (docs/reference/protocol.md): one version byte, then MessagePack [kind, field, ...].

An array is extension type 1: number of axes and three lengths as little-endian uint32, then
float64, row by row.
"""

import math
import struct
from contextlib import suppress
from functools import cache, reduce
from operator import or_
from typing import Any, cast

import msgspec
import numpy as np

from transport.model.arrays import Array
from transport.protocol.wire.bundles import BUNDLES
from transport.protocol.wire.errors_and_exit_codes import MessageError, Reason
from transport.protocol.wire.messages import KINDS, Message, Plan
from transport.protocol.wire.names import is_name

VERSION = 7
MAX_BYTES = 16 * 1024 * 1024  # plans of 256 UAVs over 800 steps

_VERSION = bytes([VERSION])
CLASSES = {**KINDS, **BUNDLES}  # by kind
_ARRAY = 1
_HEADER = struct.Struct("<4I")  # 16 bytes keep the values aligned
_AXES = 3
_FLOAT64 = np.dtype("<f8")


for _cls in CLASSES.values():
    _least = len(_cls.__struct_fields__) - len(_cls.optional)
    if _cls.__struct_fields__[_least:] != _cls.optional:
        raise TypeError(f"the last fields of {_cls.kind} have to be {_cls.optional}")


class _Kind(msgspec.Struct, frozen=True, array_like=True):
    kind: str


class Header(_Kind, frozen=True):
    """The beginning of a message, read without the rest."""

    sender: str
    incarnation: int
    sequence: int
    tick: int


def encode(message: Message) -> bytes:
    """Return the bytes of a message; its last optional fields do not travel where they are empty."""
    sent = _fields_sent(message)
    if sent < len(message.__struct_fields__):
        fields = [getattr(message, name) for name in message.__struct_fields__[:sent]]
        return _VERSION + _ENCODER.encode([message.kind, *fields])
    return _VERSION + _ENCODER.encode(message)


def _fields_sent(message: Message) -> int:
    """Return how many fields of a message travel."""
    sent = len(message.__struct_fields__)
    for name in reversed(message.optional):
        value = getattr(message, name)
        if value.size if isinstance(value, np.ndarray) else value:
            break
        sent -= 1
    return sent


def encoded_length(plan: Plan) -> int:
    """Return the number of bytes of a plan, without making those of its arrays."""
    arrays = plan.uav_states, plan.inputs, plan.corrections, plan.data
    length = len(_VERSION) + len(_WITHOUT_ARRAYS.encode(plan)) - _NOTHING * len(arrays)
    length += sum([_array_length(8 * array.size) for array in arrays])
    missing = len(plan.__struct_fields__) - _fields_sent(plan)
    for name in Plan.optional[len(Plan.optional) - missing :]:
        length -= _AT_DEFAULT[name]
    return length


@cache
def _array_length(values_bytes: int) -> int:
    """Return the number of bytes of the extension that carries the values of an array.

    Its type takes one byte, and its length one, two or four behind a marker of one byte; the one of
    16 bytes has a marker of its own. Source: MessagePack, "ext format family".
    """
    content = _HEADER.size + values_bytes
    if content == _HEADER.size:
        return 2 + content
    if content < 1 << 8:
        return 3 + content
    return (4 if content < 1 << 16 else 6) + content


def decode(data: bytes) -> Message:
    """Return the message in some bytes.

    Raises: MessageError: they are no valid message of this version.
    """
    try:
        message: Message = _decoded(data, _DECODER)
        message.check()
    except MessageError as error:
        with suppress(MessageError):
            sender = header_of(data).sender
            error.sender = sender if is_name(sender) else ""
        raise
    return message


def header_of(data: bytes) -> Header:
    """Return the header of a message. Raises: MessageError: it is none of this version."""
    return cast("Header", _decoded(data, _HEADER_DECODER))


def _decoded(data: bytes, decoder: Any) -> Any:
    if len(data) > MAX_BYTES:
        raise MessageError(
            "oversized", f"message of {len(data)} bytes, at most {MAX_BYTES} allowed"
        )
    if data and data[0] != VERSION:
        raise MessageError("wrong_version", f"protocol version {data[0]}, expected {VERSION}")
    try:
        return decoder.decode(memoryview(data)[1:])
    except msgspec.ValidationError as error:
        cause = error.__cause__
        raise cause if isinstance(cause, MessageError) else _refusal(str(error), data) from error
    except MessageError:
        raise
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise MessageError("malformed", f"not MessagePack ({type(error).__name__})") from error


def _refusal(text: str, data: bytes) -> MessageError:
    """Return the error of a message that msgspec refuses.

    Its text is such as "Expected `int` >= 0 - at `$[3]`".
    """
    text, _, place = text.partition(" - at `$[")
    if text.startswith("Invalid value"):
        return MessageError("unknown_kind", f"unknown message kind {text[14:54]}")
    number = int(place.split("]")[0]) if place else 0  # of the field, 0 for the kind
    field = ""
    reason: Reason = "wrong_shape"
    if number:
        if any(word in text for word in (" length ", " <= ", " >= ", "enum")):
            reason = "not_finite" if _LARGEST_FLOAT in text else "out_of_range"
        with suppress(msgspec.DecodeError, RecursionError, KeyError):
            kind = _KIND_DECODER.decode(memoryview(data)[1:]).kind
            field = f"{CLASSES[kind].__struct_fields__[number - 1]}: "
    elif " length " not in text:
        reason = "malformed"  # no list that begins with a kind
    return MessageError(reason, f"{field}{text[0].lower()}{text[1:120]}".replace("`", ""))


def _pack(value: Any) -> Any:
    """Return an array or a number of NumPy in the types of MessagePack."""
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray) or value.ndim > _AXES:
        raise TypeError(f"cannot send {type(value).__name__}")
    lengths = [*value.shape, *[0] * (_AXES - value.ndim)]
    values = value.astype(_FLOAT64, copy=False).tobytes()
    return msgspec.msgpack.Ext(_ARRAY, _HEADER.pack(value.ndim, *lengths) + values)


def _pack_without_arrays(value: Any) -> Any:
    """Return None for an array, and a number of NumPy as a number."""
    return None if isinstance(value, np.ndarray) else _pack(value)


def _unpack_array(code: int, data: memoryview) -> Array:
    """Return the array in an extension. Raises: MessageError: it is none."""
    if code != _ARRAY or len(data) < _HEADER.size:
        raise MessageError("malformed", f"unknown extension type {code} of {len(data)} bytes")
    axes, *lengths = _HEADER.unpack_from(data)
    shape = tuple(lengths[:axes])
    if axes > _AXES or len(data) - _HEADER.size != 8 * math.prod(shape):
        raise MessageError(
            "malformed", f"array of {axes} axes, lengths {lengths}, in {len(data)} bytes"
        )
    # A copy is aligned, and does not keep its bundle.
    return np.ndarray(shape, _FLOAT64, bytes(data), _HEADER.size)


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_pack)
_WITHOUT_ARRAYS = msgspec.msgpack.Encoder(enc_hook=_pack_without_arrays)
_NOTHING = 1  # bytes of None
_LARGEST_FLOAT = "e+308"  # in the text of a bound of `Finite`
# Bytes by which the header of the list of a plan's fields is longer for its last ones: with own data
# the list has 16 entries, its kind among them, and headers are of 1 byte up to 15 entries, then of 3.
_FIELDS_HEADER = 2
# Bytes by which a plan is shorter where one of its optional fields, with those after it, does not travel.
_AT_DEFAULT = {
    "data": _array_length(0) + _FIELDS_HEADER,
    "stale": 1,  # the number 0
    "targets": 1,  # an empty list
    "lag": 1,  # the number 0
}
_DECODER: Any = msgspec.msgpack.Decoder(reduce(or_, CLASSES.values()), ext_hook=_unpack_array)
_HEADER_DECODER = msgspec.msgpack.Decoder(Header)
_KIND_DECODER = msgspec.msgpack.Decoder(_Kind)
