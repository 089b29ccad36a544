"""Digests of values: equal for equal numbers, whatever object holds them; and results shared by them.

An array that is changed in place has another digest than before.
"""

import hashlib
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, Generic, TypeVar
from weakref import WeakValueDictionary

import numpy as np

T = TypeVar("T")

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


class SharedResults(Generic[T]):
    """Results by digests of the values that they follow from, as long as a controller holds them.

    They save repeated Riccati recursions: in an in-memory run all agents have the same law.
    """

    def __init__(self) -> None:
        self._results: WeakValueDictionary[bytes, T] = WeakValueDictionary()

    def get(self, key: bytes, compute: Callable[[], T]) -> T:
        """Return the result of a key, computed by the first who needs it."""
        result = self._results.get(key)
        if result is None:
            result = compute()
            self._results[key] = result
        return result
