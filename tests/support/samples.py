"""One valid message or bundle of every kind, as the fields it is built from."""

from types import SimpleNamespace
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from protocol.wire.fields import (
    Age,
    Agent,
    Ages,
    Check,
    Counts,
    End,
    Finite,
    Flag,
    Ids,
    KeyEnds,
    Name,
    Number,
    Parts,
    Shape,
    Text,
    checks,
)
from protocol.wire.messages import (
    BUNDLES,
    KINDS,
    Control,
    FaultNote,
    LinkChange,
    Message,
    PlantState,
    Rejected,
    Roster,
)
from protocol.wire.names import AGENT

HEAD: dict[str, Any] = {"incarnation": 1, "sequence": 7, "tick": 3}

# A valid value of each field type; other integers and lists of integers are small.
BY_TYPE: dict[Any, Any] = {
    Name: "agent2",
    End: "agent1",
    Number: 2,
    Age: 1,
    Agent: 2,
    Ids: (2, 4),
    Counts: (0, 5),
    Ages: (1, -1),
    Finite: 1e-9,
    Flag: True,
    Text: "text",
    KeyEnds: ("plan/2", "report/2"),
    Parts: (b"plan", b"\x00report"),
    int: 1,
    tuple: (3, -2),
}

# Fields of single message kinds whose values tests rely on.
OWN: dict[type[Message], dict[str, Any]] = {
    Roster: {"agents": (1, 3), "off": (2, 3), "released": (3,)},
    LinkChange: {"target": "", "settings": '{"delay_s": 0.1}'},
    PlantState: {"diverged": ""},
    FaultNote: {"target": "agent3", "what": "killed"},
    Rejected: {"offender": "agent3", "reason": "not_finite", "example": "inputs: expected finite numbers, got nan"},
    Control: {"outcome": "aborted", "exit_code": 4},
}

# Number of rows of an array of any length.
ROWS = 3


def type_of_field(kind: type[Message], field: str) -> Any:
    """Return the type of a field: one of `protocol.wire.fields`, or its plain type."""
    hint = get_type_hints(kind, include_extras=True)[field]
    if hint in BY_TYPE or get_origin(hint) is Literal:
        return hint
    plain = get_type_hints(kind)[field]
    return get_origin(plain) or plain


def array_of(check: Check, values: dict[str, Any], rows: int = ROWS) -> tuple[int, ...]:
    """Return the shape of an array field, given the other fields of the message."""
    assert isinstance(check, Shape)
    return tuple(rows if length is None else length for length in check.of(SimpleNamespace(**values)))


def fields(kind: type[Message]) -> dict[str, Any]:
    """Return valid fields of a message class, new objects on every call."""
    sender = kind.route.sender
    values = HEAD | {"sender": "agent2" if sender in (AGENT, None) else sender} | OWN.get(kind, {})
    for field, check in checks(kind):
        if field in values:
            continue
        if isinstance(check, Shape):
            shape = array_of(check, values)
            values[field] = np.arange(float(np.prod(shape))).reshape(shape)
        else:
            hint = type_of_field(kind, field)
            values[field] = get_args(hint)[0] if get_origin(hint) is Literal else BY_TYPE[hint]
    return values


def sample(kind: type[Message], **changes: Any) -> Message:
    """Return a valid message with some fields changed."""
    return kind(**fields(kind) | changes)


def samples() -> list[Message]:
    """Return one message and one bundle of every kind."""
    return [sample(kind) for kind in (*KINDS.values(), *BUNDLES.values())]
