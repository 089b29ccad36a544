"""Digests of values: equal for equal numbers, whatever object holds them.

Keys of results that are shared by what they follow from. An array that is changed in place has
another digest than before.
"""

import hashlib
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

_BYTES = 16  # of a digest: no two values of a process have the same


def digest(*values: Any) -> bytes:
    """Return the digest of numbers, texts, arrays, sequences, sets and dataclasses of these.

    Raises: TypeError: a value of another type, whose numbers are not known.
    """
    hashed = hashlib.blake2b(digest_size=_BYTES)
    for value in values:
        _add(hashed, value)
    return hashed.digest()


def _add(hashed: Any, value: Any) -> None:
    """Add a value, begun by its type and length, so that no two values run together."""
    match value:
        case None | bool() | int() | float() | str() | bytes():
            hashed.update(f"{type(value).__name__} {value!r};".encode())
        case np.ndarray():
            hashed.update(f"array {value.dtype.str} {value.shape};".encode())
            hashed.update(np.ascontiguousarray(value).tobytes())
        case list() | tuple():
            hashed.update(f"sequence {len(value)};".encode())
            for element in value:
                _add(hashed, element)
        case set() | frozenset():
            _add(hashed, sorted(value))
        case _ if is_dataclass(value):
            hashed.update(f"{type(value).__qualname__};".encode())
            for field in fields(value):
                _add(hashed, getattr(value, field.name))
        case _:
            raise TypeError(f"expected numbers, texts, arrays or dataclasses, got {type(value)}")
