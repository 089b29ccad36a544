"""Results that the controllers of one process share."""

from collections.abc import Callable
from typing import Generic, TypeVar
from weakref import WeakValueDictionary

T = TypeVar("T")


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
