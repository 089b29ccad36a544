"""Form of every message: limits, types of fields, routes, shapes of arrays, the order of a kind."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import msgspec
from msgspec import Meta

from transport.model.arrays import Array, all_finite
from transport.model.state import ALL_SENSORS
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.names import MAX_UAVS

# Limits of a message; anything beyond them is refused, from any sender.
MAX_HORIZON = 10_000  # steps of a plan
MAX_NEGOTIATION_ITERATIONS = 20
MAX_TICK = 2**48
MAX_TEXT = 1_000  # characters
MAX_KEY = 80  # characters
MAX_PARTS = 1_024  # messages of a bundle
MAX_NAMES = 64  # numbers of a note
MAX_NAME = 80  # characters of the name of a number
MAX_POINTS = 256  # of a target
MAX_DATA = 512  # numbers of a controller of the user in a plan: 4 KB
MAX_ROWS = 65_536  # plans in a report of the radio
MAX_TARGETS = 1_000  # of one run: a process that joins receives all of them
MAX_CARRIED = 8  # targets that a plan carries
SOLID = 11  # numbers of a solid that is seen
MAX_SOLIDS = 64  # that are near at once
ENDLESS_M = 1e6  # half size of a solid without ends, m
MAX_TARGET = 16_384  # bytes of one of them: more than one of `MAX_POINTS` has

_LARGEST = sys.float_info.max
Count = Annotated[int, Meta(ge=0, le=MAX_TICK)]
Age = Annotated[int, Meta(ge=-1, le=MAX_TICK)]
Agent = Annotated[int, Meta(ge=1, le=MAX_UAVS)]
# Ids of agents or UAVs, 1-based, ascending.
Ids = Annotated[tuple[Agent, ...], Meta(max_length=MAX_UAVS)]
Counts = Annotated[tuple[Count, ...], Meta(max_length=MAX_UAVS)]
Sensors = Annotated[
    tuple[Annotated[int, Meta(ge=0, le=ALL_SENSORS)], ...], Meta(max_length=MAX_UAVS)
]
Rows = Annotated[tuple[Count, ...], Meta(max_length=MAX_ROWS)]
Ages = Annotated[tuple[Age, ...], Meta(max_length=MAX_UAVS)]
PlanTicks = Annotated[
    tuple[Annotated[int, Meta(ge=-3, le=MAX_TICK)], ...], Meta(max_length=MAX_UAVS)
]
Finite = Annotated[float, Meta(ge=-_LARGEST, le=_LARGEST)]
Text = Annotated[str, Meta(max_length=MAX_TEXT)]
# Instants of the common clock, ns since 1970; 0 before there is one.
Instants = Annotated[int, Meta(ge=0, le=2**63 - 1)]
KeyEnds = Annotated[
    tuple[Annotated[str, Meta(max_length=MAX_KEY)], ...], Meta(max_length=MAX_PARTS)
]
Names = Annotated[tuple[Annotated[str, Meta(max_length=MAX_NAME)], ...], Meta(max_length=MAX_NAMES)]
Parts = Annotated[tuple[bytes, ...], Meta(max_length=MAX_PARTS)]
Carried = Annotated[
    tuple[Annotated[bytes, Meta(max_length=MAX_TARGET)], ...], Meta(max_length=MAX_CARRIED)
]

# Shape of an array from the other fields of its message; None for a first axis of any length.
ShapeOf = Callable[[Any], tuple[int | None, ...]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """Keys, publishers, subscribers and order of a kind of message.

    Attributes:
        sender: Role that publishes it; None for any process.
        number: Field with the number of its sender among the agents, or the UAVs.
        receivers: Roles that subscribe to it.
        key: Beginning of its key: the kind, unless it shares the key of another kind.
        each: Field that ends the key, "agent" or "sender"; empty where there is one key for all.
        unshared_key: Beginning of the key if its field `shared` is false; agents do not subscribe
            to that.
        grows: Field that grows from message to message: "sequence", "tick" or one of its own.
        falls: Field that falls while the other stays the same.
    """

    sender: str | None
    number: str = "agent"
    receivers: tuple[str, ...]
    key: str = ""
    each: str = ""
    unshared_key: str = ""
    grows: str = "sequence"
    falls: str = ""
    # Whether it comes from the process of the UAV in place of the sender where a run has vehicles.
    by_vehicles: bool = False


class Message(
    msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True, kw_only=True
):
    """Fields of every message; subclasses give their kind as `tag`.

    Fields travel by position, in the order of definition (docs/reference/protocol.md lists them). A new field
    of a kind comes last and has a default, or `VERSION` in codec.py grows and older logs cannot be
    read. Its last fields, `optional`, do not travel where they and those after them are empty or zero.
    """

    kind: ClassVar[str]
    route: ClassVar[Route]
    shapes: ClassVar[Mapping[str, ShapeOf]] = {}  # of its arrays, by field
    as_long: ClassVar[tuple[str, ...]] = ()  # lists that are as long as each other
    optional: ClassVar[tuple[str, ...]] = ()  # its last fields, which need not travel

    sender: str  # process name
    incarnation: Count  # which start of that process, growing with every restart
    sequence: Count  # number of the message among all its sender sent in this incarnation, from 0
    tick: Count  # the sampling instant it belongs to, from 0

    def check(self) -> None:
        """Check arrays, and fields against each other.

        Raises: MessageError: with field, expected and got.
        """
        if self.as_long:
            self._check_lengths()
        for field, shape_of in self.shapes.items():
            value: Array = getattr(self, field)
            expected = shape_of(self)
            if not _fits(value.shape, expected):
                shown = ", ".join("any" if length is None else str(length) for length in expected)
                text = f"{field}: expected shape ({shown}), got {value.shape}"
                raise MessageError("wrong_shape", text)
            if value.size and not all_finite(value):
                text = f"{field}: expected finite numbers, got nan or infinity"
                raise MessageError("not_finite", text)

    def _check_lengths(self) -> None:
        """Refuse lists that are not as long as the first one."""
        first, *others = self.as_long
        expected = len(getattr(self, first))
        for field in others:
            got = len(getattr(self, field))
            if got != expected:
                text = f"{field}: expected one for each of {expected} {first}, got {got}"
                raise MessageError("wrong_shape", text)

    @property
    def place(self) -> tuple[int, int]:
        """Value that grows from each message of its kind and sender to the next.

        Source: docs/reference/protocol.md.
        """
        route = self.route
        falling = getattr(self, route.falls) if route.falls else 0
        return getattr(self, route.grows), -falling


def _fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    """Return whether an array has an expected shape; None as the first length fits any."""
    if expected[0] is None:
        return len(shape) == len(expected) and shape[1:] == expected[1:]
    return shape == expected


def kinds_below(base: type[Message]) -> dict[str, type[Message]]:
    """Set the kind of every subclass from its tag, and return the subclasses by kind."""
    for cls in base.__subclasses__():
        cls.kind = str(cls.__struct_config__.tag)
    return {cls.kind: cls for cls in base.__subclasses__()}
