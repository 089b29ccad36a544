"""The catalogue of messages.

One valid message or bundle of every kind, any valid one (Hypothesis), and their bytes.
"""

import struct
from types import SimpleNamespace
from typing import Any, TypeVar

import msgpack
import msgspec
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from hypothesis.strategies import DrawFn, SearchStrategy
from msgspec import inspect

from transport.protocol.wire.bundles import BUNDLES
from transport.protocol.wire.codec import CLASSES, VERSION
from transport.protocol.wire.messages import (
    KINDS,
    Control,
    FaultNote,
    LinkChange,
    Measurement,
    Message,
    Plan,
    PlantState,
    Rejected,
    Roster,
    Target,
    Tick,
)
from transport.protocol.wire.names import (
    AGENT,
    COORDINATOR,
    PLANT,
    RECORDER,
    VEHICLE,
    agent_name,
    vehicle_name,
)

M = TypeVar("M", bound=Message)

# Number of rows of an array of any length, of a sample; most entries, UAVs and steps of a drawn
# message.
ROWS, FEW = 3, 4

# Fields whose values tests rely on, or that types do not tell.
OWN: dict[type[Message], dict[str, Any]] = {
    Tick: {"roster": 1},
    Roster: {"agents": (1, 3), "off": (2, 3), "released": (3,)},
    LinkChange: {"number": 2, "source": "agent1", "target": "", "settings": '{"delay_s": 0.1}'},
    Target: {"approach_s": 4.0, "approach_ramp_s": 2.0, "way_s": 2.0, "way_ramp_s": 1.0},
    PlantState: {"diverged": ""},
    FaultNote: {"target": "agent3", "what": "killed"},
    Rejected: {
        "offender": "agent3",
        "reason": "not_finite",
        "example": "inputs: expected finite numbers, got nan",
    },
    Control: {"outcome": "aborted", "exit_code": 4},
}
_NAMES = st.sampled_from([COORDINATOR, PLANT, RECORDER]) | st.integers(1, 256).map(agent_name)


def changed(message: M, **changes: Any) -> M:
    """Return a message with some fields changed."""
    return msgspec.structs.replace(message, **changes)


# Form of the states of UAVs that decides on the form of other fields, before they are there.
STATES = {"uav_states": np.zeros((1, 12))}


def fields(kind: type[Message]) -> dict[str, Any]:
    """Return valid fields of a message class, new objects on every call."""
    sender = kind.route.sender
    values: dict[str, Any] = {"sender": sender}
    if sender in (AGENT, None):
        values["sender"] = agent_name(2)
    if sender == VEHICLE:
        values |= {"sender": vehicle_name(2), "uav": 2}
    values |= {"incarnation": 1, "sequence": 7, "tick": 3} | OWN.get(kind, {})
    for field in _types(kind):
        if field not in values and field not in kind.shapes:
            values[field] = _value(_types(kind)[field], field)
    for field, shape_of in kind.shapes.items():
        shape = tuple(
            ROWS if length is None else length
            for length in shape_of(SimpleNamespace(**STATES | values))
        )
        values[field] = np.arange(float(np.prod(shape))).reshape(shape)
    return {field: values[field] for field in kind.__struct_fields__}


def sample(kind: type[Message], **changes: Any) -> Any:
    """Return a valid message with some fields changed."""
    return kind(**fields(kind) | changes)


def samples() -> list[Message]:
    """Return one message and one bundle of every kind."""
    return [sample(kind) for kind in CLASSES.values()]


def packed(*values: Any, version: int = VERSION) -> bytes:
    """Return the bytes of any values as a sender without this code would pack them."""
    body: bytes = msgpack.packb(list(values))
    return bytes([version]) + body


def array(*header: int, values: bytes = b"", code: int = 1) -> msgpack.ExtType:
    """Return an array as it travels, with any header."""
    return msgpack.ExtType(code, struct.pack("<4I", *header) + values)


def content(message: Message) -> list[Any]:
    """Return kind and fields of a message as msgpack has them, arrays as extension types."""

    def plain(value: Any) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        return array(
            value.ndim, *value.shape, *[0] * (3 - value.ndim), values=value.astype("<f8").tobytes()
        )

    values = [plain(getattr(message, field)) for field in message.__struct_fields__]
    for name in reversed(message.optional):
        value = getattr(message, name)
        if value.size if isinstance(value, np.ndarray) else value:
            break
        values.pop()
    return [message.kind, *values]


def _types(kind: type[Message]) -> dict[str, inspect.Type]:
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    return {field.name: field.type for field in info.fields}


def _value(hint: inspect.Type, field: str) -> Any:
    """Return a valid value of a field by its type."""
    match hint:
        case inspect.VarTupleType(item_type=inspect.IntType(ge=least)):
            return {1: (2, 4), 0: (0, 5), -1: (1, -1)}.get(least or 0, (3, -2))
        case inspect.VarTupleType(item_type=inspect.StrType()) if field != "keys":
            return "error_m", "thrust_N"
        case inspect.VarTupleType():
            return ("plan/2", "report/2") if field == "keys" else (b"plan", b"\x00report")
        case inspect.IntType():
            return 2 if field == "agent" else 1
        case inspect.FloatType():
            return 1e-9
        case inspect.BoolType():
            return True
        case inspect.LiteralType(values=words):
            return words[0]
    return "text"


def _drawn(hint: inspect.Type) -> SearchStrategy[Any]:
    """Return the strategy of a field by its type."""
    match hint:
        case inspect.VarTupleType(item_type=inspect.IntType(ge=1) as entry):  # ids
            return st.lists(_drawn(entry), max_size=FEW, unique=True).map(sorted).map(tuple)
        case inspect.VarTupleType(item_type=entry):
            return st.lists(_drawn(entry), max_size=FEW).map(tuple)
        case inspect.IntType(ge=least, le=most):
            return st.integers(least, most or 2**48)
        case inspect.FloatType(ge=least, le=most):
            return st.floats(least, most, allow_nan=False, allow_infinity=False)
        case inspect.BoolType():
            return st.booleans()
        case inspect.BytesType():
            return st.binary(max_size=40)
        case inspect.LiteralType(values=words):
            return st.sampled_from(words)
    return st.text(max_size=40)


@st.composite
def _message(draw: DrawFn, kind: type[Message]) -> Message:
    named = {"sender": _NAMES, "source": _NAMES | st.just(""), "target": _NAMES | st.just("")}
    values = {
        field: draw(named.get(field, _drawn(hint)))
        for field, hint in _types(kind).items()
        if field not in kind.shapes
    }
    shortest = min((len(values[field]) for field in kind.as_long), default=0)
    values |= {field: values[field][:shortest] for field in kind.as_long}
    if kind is Roster:
        values["released"] = values["off"][1:]
    if kind is Measurement:
        values["missing"] = draw(st.just(()) | st.just((1,) * len(values["uavs"])))
    if kind is Plan:
        for field in ("stale", "lag"):
            values[field] = draw(st.just(0) | st.integers(0, values["tick"]))
    rows = draw(st.integers(1, FEW))
    for field, shape_of in kind.shapes.items():
        none = field in ("corrections", "data") and draw(st.booleans())
        shape = tuple(
            (0 if none else rows) if n is None else n
            for n in shape_of(SimpleNamespace(**STATES | values))
        )
        values[field] = draw(arrays.arrays("float64", shape, elements=_drawn(inspect.FloatType())))
    return kind(**values)


messages: SearchStrategy[Message] = st.one_of([_message(kind) for kind in KINDS.values()])
bundles: SearchStrategy[Message] = st.one_of([_message(kind) for kind in BUNDLES.values()])
