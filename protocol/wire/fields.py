"""Types of message fields: each is an annotation that carries the check of its values.

A check returns the value as plain Python or a read-only float64 array, or raises `MessageError` with the field, what
was expected and what came.
"""

import dataclasses
import math
import operator
import reprlib
from collections.abc import Callable
from functools import cache
from types import UnionType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from model.arrays import Array, NotFiniteError, ShapeError, checked
from protocol.wire.names import MAX_UAVS, agent_name, is_name

# Limits of a message; anything beyond them is refused, from any sender.
MAX_HORIZON = 10_000
MAX_NEGOTIATION_ITERATIONS = 20
MAX_TICK = 2**48
MAX_TEXT = 1_000
MAX_KEY = 80
MAX_PARTS = 1_024

# Values in error texts: a few entries of a few levels.
_BRIEFLY = reprlib.Repr()
_BRIEFLY.maxstring = _BRIEFLY.maxother = _BRIEFLY.maxlong = 60

_FLOAT64 = np.dtype(np.float64)
_AGENT_NAMES = frozenset(agent_name(agent) for agent in range(1, MAX_UAVS + 1))

# Why a message is refused: docs/protocol.md says what each means.
Reason = Literal[
    "oversized",
    "wrong_version",
    "malformed",
    "unknown_kind",
    "wrong_shape",
    "not_finite",
    "out_of_range",
    "wrong_sender",
    "unknown_agent",
    "wrong_incarnation",
    "replayed",
    "past",
    "future",
    "wrong_uavs",
    "outside_limits",
]


class MessageError(ValueError):
    """A message that is refused.

    Args:
        reason: One of a few.
        text: The field, what was expected and what came.
        sender: Sender according to the message, where that could be read.
    """

    def __init__(self, reason: Reason, text: str, sender: str = "") -> None:
        super().__init__(text)
        self.reason, self.sender = reason, sender


# Field, value and the fields of the message that were checked before -> the value to keep.
Check = Callable[[str, Any, Any], Any]


def _name(field: str, value: Any, _message: Any) -> str:
    if type(value) is str and value in _AGENT_NAMES:
        return value
    if not is_name(value):
        raise MessageError(_reason(value, str), f"{field}: expected a process name, got {_shown(value)}")
    return str(value)


def _end(field: str, value: Any, message: Any) -> str:
    return value if isinstance(value, str) and not value else _name(field, value, message)


def integer(low: int = 0, high: int = MAX_TICK) -> Check:
    """Return the check of an integer in [low, high]."""

    def check(field: str, value: Any, _message: Any) -> int:
        if type(value) is int and low <= value <= high:
            return value
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or not low <= value <= high:
            text = f"{field}: expected an integer in [{low}, {high}], got {_shown(value)}"
            raise MessageError(_reason(value, int | np.integer), text)
        return int(value)

    return check


def integers(low: int = 0, high: int = MAX_TICK) -> Check:
    """Return the check of a list of at most `MAX_UAVS` integers in [low, high]."""
    check_entry = integer(low, high)

    def check(field: str, value: Any, message: Any) -> tuple[int, ...]:
        if not isinstance(value, tuple | list) or len(value) > MAX_UAVS:
            text = f"{field}: expected a list of at most {MAX_UAVS}, got {_shown(value)}"
            raise MessageError(_reason(value, tuple | list), text)
        for i in value:
            if type(i) is not int or not low <= i <= high:
                return tuple([check_entry(field, i, message) for i in value])
        return value if type(value) is tuple else tuple(value)

    return check


_id_list = integers(1, MAX_UAVS)


def _ids(field: str, value: Any, message: Any) -> tuple[int, ...]:
    if type(value) is tuple:  # the usual case in one pass: several lists of ids come with every message
        last = 0
        for i in value:
            if type(i) is not int or i <= last:
                break
            last = i
        else:
            if last <= MAX_UAVS:
                return value
    ids: tuple[int, ...] = _id_list(field, value, message)
    if any(map(operator.ge, ids, ids[1:])):
        raise MessageError("out_of_range", f"{field}: expected ascending ids, got {list(ids)}")
    return ids


def _number(field: str, value: Any, _message: Any) -> float:
    if type(value) is float and math.isfinite(value):
        return value
    if isinstance(value, bool) or not isinstance(value, int | float | np.floating) or not np.isfinite(value):
        reason: Reason = "not_finite" if isinstance(value, float | np.floating) else "wrong_shape"
        raise MessageError(reason, f"{field}: expected a finite number, got {_shown(value)}")
    return float(value)


def _flag(field: str, value: Any, _message: Any) -> bool:
    if not isinstance(value, bool):
        raise MessageError("wrong_shape", f"{field}: expected true or false, got {_shown(value)}")
    return value


def _text(field: str, value: Any, _message: Any) -> str:
    # Half of a surrogate pair is text for Python but cannot be sent.
    if (
        not isinstance(value, str)
        or len(value) > MAX_TEXT
        or not (value.isascii() or all(not "\ud800" <= c <= "\udfff" for c in value))
    ):
        text = f"{field}: expected text of at most {MAX_TEXT} characters, got {_shown(value)}"
        raise MessageError(_reason(value, str), text)
    return value


def _each(check_entry: Check) -> Check:
    """Return the check of a list of at most `MAX_PARTS` entries."""

    def check(field: str, value: Any, message: Any) -> tuple[Any, ...]:
        if not isinstance(value, tuple | list) or len(value) > MAX_PARTS:
            text = f"{field}: expected a list of at most {MAX_PARTS}, got {_shown(value)}"
            raise MessageError(_reason(value, tuple | list), text)
        return tuple([check_entry(field, entry, message) for entry in value])

    return check


def _key(field: str, value: Any, _message: Any) -> str:
    if not isinstance(value, str) or len(value) > MAX_KEY or not value.isascii():
        text = f"{field}: expected keys of at most {MAX_KEY} ASCII characters, got {_shown(value)}"
        raise MessageError(_reason(value, str), text)
    return value


def _part(field: str, value: Any, _message: Any) -> bytes:
    if not isinstance(value, bytes):
        raise MessageError("wrong_shape", f"{field}: expected bytes, got {_shown(value)}")
    return value


def _one_of(words: tuple[str, ...]) -> Check:
    def check(field: str, value: Any, _message: Any) -> str:
        if not isinstance(value, str) or value not in words:
            raise MessageError(_reason(value, str), f"{field}: expected one of {', '.join(words)}, got {_shown(value)}")
        return value

    return check


@dataclasses.dataclass(frozen=True, slots=True)
class Shape:
    """Check of an array of finite numbers.

    Args:
        of: Its shape, from the other fields of the message; None for an axis of any length.
    """

    of: Callable[[Any], tuple[int | None, ...]]

    def __call__(self, field: str, value: Any, message: Any) -> Array:
        """Return the array, read-only; without a copy if it lies in the bytes it was received in."""
        if not isinstance(value, np.ndarray):
            raise MessageError("wrong_shape", f"{field}: expected an array, got {_shown(value)}")
        shape = self.of(message)
        if _is_as_decoded(value, shape) and math.isfinite(np.vdot(value, value)):
            return value
        try:
            return checked(field, value, shape)
        except NotFiniteError as error:
            raise MessageError("not_finite", str(error)) from error
        except ShapeError as error:
            raise MessageError("wrong_shape", str(error)) from error


Name = Annotated[str, _name]
# One end of a link: a process name, or empty for any agent.
End = Annotated[str, _end]
Count = Annotated[int, integer()]
# From 1.
Number = Annotated[int, integer(1)]
# In one notice, of which there is one a second: a process reads less, so that more is forged.
MAX_REFUSALS = 10_000_000
Refusals = Annotated[int, integer(1, MAX_REFUSALS)]
# In ticks; -1 where nothing was ever received.
Age = Annotated[int, integer(-1)]
Agent = Annotated[int, integer(1, MAX_UAVS)]
# Ids of agents or UAVs, 1-based, ascending.
Ids = Annotated[tuple[int, ...], _ids]
Counts = Annotated[tuple[int, ...], integers()]
Ages = Annotated[tuple[int, ...], integers(-1)]
Finite = Annotated[float, _number]
Flag = Annotated[bool, _flag]
Text = Annotated[str, _text]
# Keys without the prefix of the run, and encoded messages.
KeyEnds = Annotated[tuple[str, ...], _each(_key)]
Parts = Annotated[tuple[bytes, ...], _each(_part)]


def _checks(message: type) -> tuple[tuple[str, Check], ...]:
    """Return the fields of a message class with their checks, arrays last: their shapes depend on other fields."""
    hints = get_type_hints(message, include_extras=True)
    found = [(field.name, _check_of(hints[field.name])) for field in dataclasses.fields(message)]
    return tuple(sorted(found, key=lambda entry: isinstance(entry[1], Shape)))


checks: Callable[[type], tuple[tuple[str, Check], ...]] = cache(_checks)


def _check_of(hint: Any) -> Check:
    if get_origin(hint) is Literal:
        return _one_of(get_args(hint))
    check: Check = hint.__metadata__[0]
    return check


def _is_as_decoded(value: Array, shape: tuple[int | None, ...]) -> bool:
    """Return whether an array of this shape lies in immutable received bytes, so that it needs no copy."""
    owner: object = value.base
    if not isinstance(owner, bytes) or value.dtype is not _FLOAT64:
        return False
    return len(value.shape) == len(shape) and value.shape[1:] == shape[1:] and shape[0] in (None, value.shape[0])


def _reason(value: object, expected: type | UnionType) -> Reason:
    """Return why a value is refused: its type, or else its size."""
    right = isinstance(value, expected) and not isinstance(value, bool)
    return "out_of_range" if right else "wrong_shape"


def _shown(value: object) -> str:
    text = " ".join(_BRIEFLY.repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
