"""Arrays of the project: float64, checked at construction, read-only from then on."""

import math
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
ArrayLike = npt.ArrayLike
Rows = slice | npt.NDArray[np.intp]

T = TypeVar("T")


class ShapeError(ValueError):
    """An array of the wrong shape or not finite.

    The text names it, the expected and the actual value.
    """


def checked(name: str, value: ArrayLike, shape: Sequence[int | None]) -> Array:
    """Return a read-only, C-contiguous float64 copy of a shape, None for any length.

    Raises: ShapeError: not of it.
    """
    try:
        array = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise ShapeError(f"{name}: expected an array of numbers, got {value!r}") from error

    has_shape = array.ndim == len(shape) and all(
        length in (None, actual) for length, actual in zip(shape, array.shape, strict=True)
    )
    if not has_shape:
        expected = ", ".join("any" if length is None else str(length) for length in shape)
        got = ", ".join(map(str, array.shape))
        raise ShapeError(f"{name}: expected shape ({expected}), got ({got})")

    is_finite = np.isfinite(array)
    if not is_finite.all():
        raise ShapeError(f"{name}: expected finite numbers, got {array[~is_finite][0]}")
    frozen(array)
    return array


def frozen(*arrays: npt.NDArray[Any]) -> None:
    """Make arrays read-only."""
    for array in arrays:
        array.setflags(write=False)


def all_finite(array: Array) -> bool:
    """Return whether all numbers are finite; the first test takes one pass, but large numbers overflow."""
    return math.isfinite(np.vdot(array, array)) or bool(np.isfinite(array).all())


def ascending(*arrays: npt.ArrayLike) -> Array:
    """Return the distinct numbers of arrays in ascending order, without NaN.

    `numpy.unique` imports masked arrays at its first call: 10 ms of each start.
    """
    ordered = np.sort(np.concatenate(arrays, dtype=np.float64))
    is_first = np.ones(len(ordered), dtype=bool)
    is_first[1:] = ordered[1:] != ordered[:-1]
    return ordered[is_first]


def within(array: Array, largest: float) -> bool:
    """Return whether all magnitudes are at most the largest; NaN is not.

    The first test takes a third of the time, and settles all but large numbers.
    """
    return bool(np.vdot(array, array) <= largest**2 or np.abs(array).max(initial=0.0) <= largest)


def assign(instance: object, **values: Any) -> None:
    """Set the fields of a frozen dataclass while it is constructed."""
    for name, value in values.items():
        object.__setattr__(instance, name, value)


def padded(rows: Array, columns: int) -> Array:
    """Return rows with zeros behind them, up to a number of columns.

    The rows themselves if they have as many.
    """
    missing = columns - rows.shape[1]
    if not missing:
        return rows
    return np.pad(rows, ((0, 0), (0, missing)))


def rows(start: int, steps: int, known: int) -> Rows:
    """Return rows from `start` on; those that are not known are replaced by the nearest."""
    if 0 <= start <= known - steps:
        return slice(start, start + steps)
    return np.clip(np.arange(start, start + steps), 0, known - 1)


def continued(before: T, after: T, kept: int) -> T:
    """Return a dataclass of rows from `first` on with up to `kept` earlier ones ahead.

    Functions, digests and numbers are those of the later.
    """
    first: int = before.first  # type: ignore[attr-defined]
    now: int = after.first  # type: ignore[attr-defined]
    count = min(kept, now - first)

    def joined(old: Any, new: Any) -> Any:
        if is_dataclass(new):
            names = [field.name for field in fields(new) if field.name != "first"]
            parts = {name: joined(getattr(old, name), getattr(new, name)) for name in names}
            return replace(new, **parts)  # type: ignore[type-var]
        if callable(new) or isinstance(new, bytes | int):
            return new

        ahead = rows(now - first - count, count, len(old))
        if isinstance(new, list):
            return [*(old[i] for i in np.arange(len(old))[ahead]), *new]
        both = np.concatenate([old[ahead], new])
        frozen(both)
        return both

    return replace(joined(before, after), first=now - count)  # type: ignore[no-any-return]
