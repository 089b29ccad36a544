"""Messages as bytes: one version byte, then msgpack; arrays as raw little-endian float64.

Layout (docs/protocol.md): `version (1 byte) | msgpack [kind, field, field, ...]`, fields in the order of the
message class. An array is msgpack extension type 1: number of axes and up to three lengths as four
little-endian uint32, then the values row by row.
"""

import dataclasses
import math
import struct
from functools import cache
from typing import Any

import msgpack
import numpy as np

from model.arrays import Array
from protocol.wire.messages import BUNDLES, KINDS, Message, MessageError
from protocol.wire.names import is_name

VERSION = 6
MAX_BYTES = 4 * 1024 * 1024  # a plan for 256 UAVs over 400 steps

_ARRAY = 1
_HEADER = struct.Struct("<4I")  # 16 bytes keep the values aligned
_AXES = 3
_FLOAT64 = np.dtype("<f8")


def encode(message: Message) -> bytes:
    """Return the bytes of a message."""
    values = [getattr(message, name) for name in field_names(message.kind)]
    body: bytes = msgpack.packb([message.kind, *values], default=_pack_array, use_bin_type=True)
    return bytes([VERSION]) + body


@cache
def field_names(kind: str) -> tuple[str, ...]:
    """Return the fields of a kind of message in the order they are sent in, after the kind."""
    return tuple(field.name for field in dataclasses.fields(class_of(kind)))


@cache
def class_of(kind: str) -> type[Message]:
    """Return the class of a kind of message or bundle.

    Raises: KeyError: there is no such kind.
    """
    return KINDS[kind] if kind in KINDS else BUNDLES[kind]


def decode(data: bytes) -> Message:
    """Return the message in some bytes.

    Raises: MessageError: they are no valid message of this version.
    """
    if not data:
        raise MessageError("malformed", "empty message")
    if len(data) > MAX_BYTES:
        raise MessageError("oversized", f"message of {len(data)} bytes, at most {MAX_BYTES} allowed")
    if data[0] != VERSION:
        raise MessageError("wrong_version", f"protocol version {data[0]}, expected {VERSION}")
    try:
        content = msgpack.unpackb(
            memoryview(data)[1:], ext_hook=_unpack_array, raw=False, strict_map_key=True, use_list=False
        )
    except MessageError:
        raise
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise MessageError("malformed", f"not msgpack ({type(error).__name__})") from error
    if not (isinstance(content, tuple) and content and isinstance(content[0], str)):
        raise MessageError("malformed", "expected a list that starts with a message kind")
    kind, values = content[0], content[1:]
    if kind not in KINDS and kind not in BUNDLES:
        raise MessageError("unknown_kind", f"unknown message kind {kind[:40]!r}")
    names = field_names(kind)
    if len(values) != len(names):
        raise MessageError("wrong_shape", f"{kind}: expected {len(names)} fields, got {len(values)}")
    try:
        return class_of(kind)(**dict(zip(names, values, strict=True)))
    except MessageError as error:
        error.sender = values[0] if is_name(values[0]) else ""
        raise


def _pack_array(value: Any) -> msgpack.ExtType:
    if not isinstance(value, np.ndarray) or value.ndim > _AXES:
        raise TypeError(f"cannot send {type(value).__name__}")
    lengths = [*value.shape, *[0] * (_AXES - value.ndim)]
    return msgpack.ExtType(_ARRAY, _HEADER.pack(value.ndim, *lengths) + value.astype(_FLOAT64, copy=False).tobytes())


def _unpack_array(code: int, data: bytes) -> Array:
    if code != _ARRAY or len(data) < _HEADER.size:
        raise MessageError("malformed", f"unknown extension type {code} of {len(data)} bytes")
    header = _HEADER.unpack_from(data)
    axes = header[0]
    if axes > _AXES:
        raise MessageError("malformed", f"array of {axes} axes, at most {_AXES} allowed")
    shape = header[1 : 1 + axes]
    if len(data) - _HEADER.size != 8 * math.prod(shape):
        raise MessageError("malformed", f"array of shape {shape} in {len(data) - _HEADER.size} bytes")
    return np.ndarray(shape, _FLOAT64, data, _HEADER.size)
