"""Base of all messages: frozen structs, the types of their fields, and the route each kind takes through the network.

msgspec checks the types and ranges of received fields; `Message.check` checks what types cannot say. Messages of this
process are not checked: receivers are.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from model.arrays import Array
from protocol.wire.names import MAX_UAVS

# Limits of a message; anything beyond them is refused, from any sender.
MAX_HORIZON = 10_000
MAX_NEGOTIATION_ITERATIONS = 20
MAX_TICK = 2**48
MAX_TEXT = 1_000
MAX_KEY = 80
MAX_NAMES, MAX_NAME = 64, 80  # numbers of a note, characters of their names
MAX_PARTS = 1_024
MAX_POINTS = 256  # of a target

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

_LARGEST = float(np.finfo(np.float64).max)

Count = Annotated[int, Meta(ge=0, le=MAX_TICK)]
# In ticks; -1 where nothing was ever received.
Age = Annotated[int, Meta(ge=-1, le=MAX_TICK)]
Agent = Annotated[int, Meta(ge=1, le=MAX_UAVS)]
# Ids of agents or UAVs, 1-based, ascending.
Ids = Annotated[tuple[Agent, ...], Meta(max_length=MAX_UAVS)]
Counts = Annotated[tuple[Count, ...], Meta(max_length=MAX_UAVS)]
Ages = Annotated[tuple[Age, ...], Meta(max_length=MAX_UAVS)]
# Tick of the plan that the actuators of each UAV follow; the negative ones are special.
PlanTicks = Annotated[tuple[Annotated[int, Meta(ge=-3, le=MAX_TICK)], ...], Meta(max_length=MAX_UAVS)]
Finite = Annotated[float, Meta(ge=-_LARGEST, le=_LARGEST)]
Text = Annotated[str, Meta(max_length=MAX_TEXT)]
# Keys without the prefix of the run, and encoded messages.
KeyEnds = Annotated[tuple[Annotated[str, Meta(max_length=MAX_KEY)], ...], Meta(max_length=MAX_PARTS)]
Names = Annotated[tuple[Annotated[str, Meta(max_length=MAX_NAME)], ...], Meta(max_length=MAX_NAMES)]
Parts = Annotated[tuple[bytes, ...], Meta(max_length=MAX_PARTS)]

# Shape of an array from the other fields of its message; None for an axis of any length.
ShapeOf = Callable[[Any], tuple[int | None, ...]]


class MessageError(ValueError):
    """A message that is refused; the sender is that according to the message, where it could be read."""

    def __init__(self, reason: Reason, text: str, sender: str = "") -> None:
        super().__init__(text)
        self.reason, self.sender = reason, sender


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """Keys, publishers, subscribers and order of a kind of message."""

    sender: str | None  # role that publishes it; None for any process
    receivers: tuple[str, ...]  # roles that subscribe to it
    key: str = ""  # beginning of its key: the kind, unless it shares the key of another kind
    each: str = ""  # field that ends the key, "agent" or "sender"; empty where there is one key for all
    unshared_key: str = ""  # beginning of the key if its field `shared` is false; agents do not subscribe to that
    grows: str = "sequence"  # field that grows from message to message: "sequence", "tick" or one of its own
    falls: str = ""  # field that falls while the other stays the same


class Message(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, kw_only=True):
    """Fields of every message; subclasses give their kind as `tag`."""

    kind: ClassVar[str]
    route: ClassVar[Route]
    shapes: ClassVar[Mapping[str, ShapeOf]] = {}  # of its arrays, by field

    sender: str  # process name
    incarnation: Count  # which start of that process, growing with every restart
    sequence: Count  # number of the message among all its sender sent in this incarnation, from 0
    tick: Count  # the sampling instant it belongs to, from 0

    def check(self) -> None:
        """Check arrays, and fields against each other.

        Raises: MessageError: with the field, what was expected and what came.
        """
        for field, shape_of in self.shapes.items():
            value: Array = getattr(self, field)
            expected = shape_of(self)
            if value.shape != expected and (
                len(value.shape) != len(expected)
                or any(b not in (None, a) for a, b in zip(value.shape, expected, strict=True))
            ):
                shown = ", ".join("any" if length is None else str(length) for length in expected)
                raise MessageError("wrong_shape", f"{field}: expected shape ({shown}), got {value.shape}")
            # The first test takes one pass, but overflows for large numbers.
            if not math.isfinite(np.vdot(value, value)) and not np.isfinite(value).all():
                raise MessageError("not_finite", f"{field}: expected finite numbers, got nan or infinity")

    @property
    def place(self) -> tuple[int, int]:
        """Value that grows from each message of its kind and sender to the next (docs/protocol.md)."""
        route = self.route
        return getattr(self, route.grows), -getattr(self, route.falls) if route.falls else 0


def lengths_fit(**lists: tuple[object, ...]) -> None:
    """Check that the lists of a message are as long as the first of them.

    Raises: MessageError: naming the field.
    """
    (first, given), *others = lists.items()
    for field, value in others:
        if len(value) != len(given):
            text = f"{field}: expected one for each of {len(given)} {first}, got {len(value)}"
            raise MessageError("wrong_shape", text)
