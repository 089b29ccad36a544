"""Validation of every field of every message at construction."""

import dataclasses
from typing import Any, Literal, get_origin, get_type_hints

import numpy as np
import pytest

from protocol.wire.fields import (
    MAX_KEY,
    MAX_PARTS,
    MAX_REFUSALS,
    Age,
    Agent,
    Count,
    End,
    Finite,
    Flag,
    Ids,
    KeyEnds,
    Name,
    Number,
    Parts,
    Refusals,
    Text,
)
from protocol.wire.messages import (
    BUNDLES,
    KINDS,
    MAX_HORIZON,
    MAX_NEGOTIATION_ITERATIONS,
    MAX_TEXT,
    MAX_TICK,
    MAX_UAVS,
    ActualInputs,
    Control,
    FaultNote,
    LinkChange,
    Measurement,
    Message,
    MessageError,
    Plan,
    PlantState,
    Rejected,
    Roster,
    StepReport,
    Tick,
)
from tests.support.samples import fields, sample

NAN, INF = float("nan"), float("inf")

# Values that a field of each sort must refuse, whatever message it belongs to.
WRONG: dict[str, list[Any]] = {
    "name": [
        "",
        "agent",
        "agent0",
        "agent01",
        "agent1000",
        "agent-1",
        "Plant",
        "plant ",
        "agent1\n",
        3,
        None,
        b"plant",
    ],
    "count": [-1, MAX_TICK + 1, 1.0, NAN, True, "1", None, [1], np.float64(1.0), np.bool_(True)],
    "refusals": [0, -1, MAX_REFUSALS + 1, 1.0, True, "1", None],
    "number": [0, -1, MAX_TICK + 1, 1.0, True, "1", None],
    "negotiation_iterations": [-1, MAX_NEGOTIATION_ITERATIONS, 1.0, True, "1", None],
    "end": ["agent", "agent0", "Plant", "any", "*", " ", 3, None, b"plant"],
    "age": [-2, MAX_TICK + 1, 1.0, True, "1", None],
    "source": [-4, MAX_TICK + 1, 1.0, True, "1", None],
    "agent": [0, -1, MAX_UAVS + 1, 1.0, True, "1", None],
    "code": [-1, 256, 4.0, True, "4", None],
    "ids": [(2, 1), (1, 1), (0, 1), (1, MAX_UAVS + 1), (1.0,), (True,), ("1",), (None,), ((1,),)],
    "float": [NAN, INF, -INF, "1", None, True, [1.0], np.float64(NAN), 1j],
    "flag": [0, 1, "true", None, np.bool_(True)],
    "text": ["x" * (MAX_TEXT + 1), 3, None, b"x", ["x"]],
    "word": ["", "Solved", "completed ", 1, None, b"solved", ["solved"], ("solved", "limit")],
    "array": [None, 1.0, "x", [1.0, 2.0], b"12345678", np.array(["x"]), np.zeros((1, 1, 1)), np.float64(1.0)],
    "list": [],  # see ENTRIES
    "keys": [
        3,
        None,
        "plan/2",
        b"x",
        {"plan/2": 1},
        (3, "a"),
        ("a", None),
        ("x" * (MAX_KEY + 1), "a"),
        ("\u00e4", "a"),
        ("a",) * (MAX_PARTS + 1),
    ],
    "parts": [
        3,
        None,
        "plan",
        b"x",
        ("x", b"y"),
        (b"y", None),
        (b"y", 3),
        (b"",) * (MAX_PARTS + 1),
        (b"y",),
        (b"y",) * 3,
    ],
}

SORTS: dict[type[Message], dict[str, str]] = {
    Tick: {
        "members": "ids",
        "answered": "ids",
        "shared": "ids",
        "roster": "count",
        "late_ns": "count",
        "overrun_ns": "count",
    },
    Roster: {
        "version": "count",
        "agents": "ids",
        "incarnations": "list",
        "off": "ids",
        "released": "ids",
        "reason": "text",
    },
    LinkChange: {"number": "number", "source": "end", "target": "end", "settings": "text"},
    Measurement: {
        "agent": "agent",
        "answered": "ids",
        "shared": "ids",
        "roster": "count",
        "payload": "array",
        "uavs": "ids",
        "uav_states": "array",
        "inputs": "array",
    },
    Plan: {
        "agent": "agent",
        "start_tick": "count",
        "negotiation": "negotiation_iterations",
        "shared": "flag",
        "uavs": "ids",
        "uav_states": "array",
        "inputs": "array",
        "corrections": "array",
        "status": "word",
    },
    StepReport: {
        "agent": "agent",
        "status": "word",
        "solver": "text",
        "fallback": "flag",
        "iterations": "count",
        "residual": "float",
        "peers": "ids",
        "plan_ages": "list",
        "state_ages": "list",
        "measurement_age": "age",
        "delivered": "count",
        "lost": "count",
        "late": "count",
        "force": "array",
        "times_ms": "array",
    },
    PlantState: {"x": "array", "u": "array", "plan_ticks": "list", "local_error": "float", "diverged": "text"},
    ActualInputs: {"uavs": "ids", "inputs": "array"},
    FaultNote: {"target": "name", "what": "text", "origin": "word"},
    Rejected: {"offender": "text", "reason": "word", "count": "refusals", "example": "text"},
    Control: {"outcome": "word", "reason": "text", "exit_code": "code"},
}
HEAD = {"sender": "name", "incarnation": "count", "sequence": "count", "tick": "count"}

# Lists whose entries are not ids, and what an entry of theirs is.
ENTRIES = {
    (Roster, "incarnations"): "count",
    (StepReport, "plan_ages"): "age",
    (StepReport, "state_ages"): "age",
    (PlantState, "plan_ticks"): "source",
}

# Messages that are not in the table are tested by the types of their fields.
SORT_OF_TYPE = {
    Name: "name",
    End: "end",
    Count: "count",
    Number: "number",
    Refusals: "refusals",
    Age: "age",
    Agent: "agent",
    Ids: "ids",
    Finite: "float",
    Flag: "flag",
    Text: "text",
    KeyEnds: "keys",
    Parts: "parts",
}
ALL_KINDS = KINDS | BUNDLES
for other in [kind for kind in ALL_KINDS.values() if kind not in SORTS]:
    hints = get_type_hints(other, include_extras=True)
    own = [field.name for field in dataclasses.fields(other) if field.name not in HEAD]
    SORTS[other] = {
        name: "word" if get_origin(hints[name]) is Literal else SORT_OF_TYPE.get(hints[name], "array") for name in own
    }

CASES = [
    pytest.param(kind, field, value, id=f"{kind.kind}-{field}-{number}")
    for kind, own in SORTS.items()
    for field, sort in (HEAD | own).items()
    for number, value in enumerate(WRONG[sort])
]
LISTS = [
    (kind, field)
    for kind, own in SORTS.items()
    for field, sort in own.items()
    if sort == "ids" or (kind, field) in ENTRIES
]
NO_LISTS: list[Any] = [3, None, "12", b"12", {1: 2}, np.array([1, 2]), tuple(range(1, MAX_UAVS + 2))]
ARRAYS = [(kind, field) for kind, own in SORTS.items() for field, sort in own.items() if sort == "array"]


def refusal(kind: type[Message], **changes: Any) -> str:
    """Error text of a message with some fields changed."""
    with pytest.raises(MessageError) as caught:
        sample(kind, **changes)
    return str(caught.value)


def test_the_table_covers_every_field() -> None:
    """The table of wrong values covers every field of every message kind."""
    for kind in ALL_KINDS.values():
        assert {field.name for field in dataclasses.fields(kind)} == set(HEAD | SORTS[kind]) == set(fields(kind))


@pytest.mark.parametrize(("kind", "field", "value"), CASES)
def test_wrong_value_is_refused(kind: type[Message], field: str, value: object) -> None:
    """A wrong value of any field is refused with a text that names the field, what was expected and what came."""
    text = refusal(kind, **{field: value})
    assert text.startswith(f"{field}: expected ")
    assert "got " in text
    assert len(text) < 300


@pytest.mark.parametrize(
    ("kind", "changes", "reason"),
    [
        (Tick, {"sender": 3}, "wrong_shape"),
        (Tick, {"sender": "agent0"}, "out_of_range"),
        (Tick, {"roster": "1"}, "wrong_shape"),
        (Tick, {"roster": True}, "wrong_shape"),
        (Tick, {"roster": -1}, "out_of_range"),
        (Tick, {"tick": 2**63}, "out_of_range"),
        (Tick, {"members": 3}, "wrong_shape"),
        (Tick, {"members": (1.0,)}, "wrong_shape"),
        (Tick, {"members": tuple(range(300))}, "out_of_range"),
        (Tick, {"members": (2, 1)}, "out_of_range"),
        (Roster, {"incarnations": (0,)}, "wrong_shape"),
        (Roster, {"reason": b"x"}, "wrong_shape"),
        (Roster, {"reason": "x" * 2000}, "out_of_range"),
        (Roster, {"reason": "\ud800"}, "out_of_range"),
        (Plan, {"status": "sold"}, "out_of_range"),
        (Plan, {"status": None}, "wrong_shape"),
        (Plan, {"inputs": [[0.0] * 8] * 3}, "wrong_shape"),
        (Plan, {"inputs": np.zeros((3, 4))}, "wrong_shape"),
        (Plan, {"inputs": np.zeros((0, 8))}, "out_of_range"),
        (Plan, {"inputs": np.full((3, 8), NAN)}, "not_finite"),
        (Plan, {"corrections": np.zeros((2, 8))}, "wrong_shape"),
        (StepReport, {"residual": INF}, "not_finite"),
        (StepReport, {"residual": "1"}, "wrong_shape"),
        (StepReport, {"fallback": 1}, "wrong_shape"),
        (StepReport, {"plan_ages": (1,)}, "wrong_shape"),
    ],
)
def test_why_a_value_is_refused(kind: type[Message], changes: dict[str, Any], reason: str) -> None:
    """The reason distinguishes wrong type or shape, not finite, and out of range."""
    with pytest.raises(MessageError) as caught:
        sample(kind, **changes)
    assert caught.value.reason == reason


@pytest.mark.parametrize(("kind", "field"), ENTRIES)
def test_wrong_entry_is_refused(kind: type[Message], field: str) -> None:
    """A wrong entry of a list is refused like a wrong value, wherever in the list it is."""
    for value in WRONG[ENTRIES[(kind, field)]]:
        for entries in ((value, 0), (0, value)):
            text = refusal(kind, **{field: entries})
            assert text.startswith(f"{field}: expected an integer")
            assert "got " in text


@pytest.mark.parametrize("value", NO_LISTS)
def test_other_values_than_lists_are_refused(value: object) -> None:
    """Anything but a list of bounded length is refused where a list belongs."""
    for kind, field in LISTS:
        assert "expected a list of at most 256, got " in refusal(kind, **{field: value})


@pytest.mark.parametrize(("kind", "field"), LISTS)
def test_field_of_a_missing_list_is_named(kind: type[Message], field: str) -> None:
    """The error about a value that is no list names its field."""
    assert refusal(kind, **{field: 3}) == f"{field}: expected a list of at most 256, got 3"


@pytest.mark.parametrize("value", [np.zeros(2), np.zeros(0), np.array(["solved", "completed"])])
def test_an_array_is_no_word(value: object) -> None:
    """An array where one of several words belongs is refused like any other wrong value."""
    words = (
        (Plan, "status"),
        (StepReport, "status"),
        (FaultNote, "origin"),
        (Rejected, "reason"),
        (Control, "outcome"),
    )
    for kind, field in words:
        assert refusal(kind, **{field: value}).startswith(f"{field}: expected one of ")


@pytest.mark.parametrize(("kind", "field"), ARRAYS)
def test_arrays_are_checked(kind: type[Message], field: str) -> None:
    """An array of a wrong shape, or with an entry that is not finite, is refused; the text names the field."""
    good = fields(kind)[field]
    for shape in (good[:-1] if good.ndim == 1 else good[:, :-1], np.zeros((*good.shape, 1)), np.zeros(())):
        text = refusal(kind, **{field: shape})
        assert text.startswith(f"{field}: expected shape (")
        assert "got (" in text
    for value in (NAN, INF, -INF):
        bad = good.copy()
        bad.flat[-1] = value
        assert refusal(kind, **{field: bad}) == f"{field}: expected finite numbers, got {value}"


@pytest.mark.parametrize(("kind", "field"), ARRAYS)
def test_arrays_are_copied_and_read_only(kind: type[Message], field: str) -> None:
    """A message owns its arrays: later changes of what it was built from do not reach it, nor can it be changed."""
    given = fields(kind)[field]
    before = given.copy()
    own = getattr(sample(kind, **{field: given}), field)
    given += 1.0
    np.testing.assert_array_equal(own, before)
    assert own.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        own[...] = 0.0


def test_integers_arrive_as_plain_float64() -> None:
    """An array of integers, or one that is not contiguous, becomes a contiguous float64 one."""
    message = sample(PlantState, x=np.arange(36), u=np.arange(16.0)[::2])
    assert isinstance(message, PlantState)
    assert message.x.dtype == np.float64
    assert message.u.flags.c_contiguous
    np.testing.assert_array_equal(message.u, np.arange(0.0, 16.0, 2.0))


def test_values_become_plain_python() -> None:
    """Numpy scalars become Python numbers and lists tuples: the wire knows no others."""
    message = sample(Tick, tick=np.int64(5), members=[np.int32(1), np.int64(2)], answered=[])
    assert isinstance(message, Tick)
    assert type(message.tick) is int
    assert message.members == (1, 2)
    assert [type(i) for i in message.members] == [int, int]
    assert message.answered == ()
    report = sample(StepReport, residual=np.float64(0.5))
    assert isinstance(report, StepReport)
    assert type(report.residual) is float


@pytest.mark.parametrize("kind", ALL_KINDS.values())
def test_messages_are_frozen(kind: type[Message]) -> None:
    """No field of a message can be set after construction, and none can be added."""
    message = sample(kind)
    for field in fields(kind):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(message, field, 0)
    with pytest.raises((AttributeError, TypeError)):
        message.extra = 0  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("kind", "changes", "text"),
    [
        (Roster, {"incarnations": (0,)}, "incarnations: expected one for each of 2 agents, got 1"),
        (Roster, {"agents": ()}, "incarnations: expected one for each of 0 agents, got 2"),
        (Roster, {"off": (2,)}, "released: expected UAVs among those off [2], got [3]"),
        (StepReport, {"plan_ages": (1,)}, "plan_ages: expected one for each of 2 peers, got 1"),
        (StepReport, {"state_ages": (1, 1, 1)}, "state_ages: expected one for each of 2 peers, got 3"),
        (Measurement, {"uavs": (2,)}, "uav_states: expected shape (1, 12), got (2, 12)"),
        (Measurement, {"inputs": np.zeros((3, 4))}, "inputs: expected shape (2, 4), got (3, 4)"),
        (Plan, {"uavs": (1, 2, 3)}, "uav_states: expected shape (3, 12), got (2, 12)"),
        (Plan, {"inputs": np.zeros((3, 4))}, "inputs: expected shape (any, 8), got (3, 4)"),
        (Plan, {"inputs": np.zeros((0, 8))}, f"inputs: expected 1 to {MAX_HORIZON} steps, got 0"),
        (
            Plan,
            {"inputs": np.zeros((MAX_HORIZON + 1, 8))},
            f"inputs: expected 1 to {MAX_HORIZON} steps, got {MAX_HORIZON + 1}",
        ),
        (Plan, {"corrections": np.zeros((2, 8))}, "corrections: expected none or 3 steps, got 2"),
        (Plan, {"corrections": np.zeros((3, 4))}, "corrections: expected shape (any, 8), got (3, 4)"),
        (PlantState, {"plan_ticks": (0,)}, "x: expected shape (24), got (36)"),
        (PlantState, {"u": np.zeros(4)}, "u: expected shape (8), got (4)"),
    ],
)
def test_fields_agree_with_each_other(kind: type[Message], changes: dict[str, Any], text: str) -> None:
    """Lengths that follow from another field are checked against it."""
    assert refusal(kind, **changes) == text


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        (Tick, {"incarnation": MAX_TICK, "sequence": MAX_TICK, "tick": MAX_TICK, "members": (), "answered": ()}),
        (Tick, {"members": tuple(range(1, MAX_UAVS + 1))}),
        (Roster, {"reason": "x" * MAX_TEXT, "agents": (), "incarnations": ()}),
        (LinkChange, {"number": 1, "source": "plant", "target": "agent4", "settings": "{}"}),
        (Plan, {"negotiation": MAX_NEGOTIATION_ITERATIONS - 1}),
        (Control, {"exit_code": 255}),
        (Control, {"exit_code": 0, "outcome": "diverged", "reason": "\N{GREEK SMALL LETTER TAU} > 0"}),
        (Plan, {"inputs": np.zeros((MAX_HORIZON, 8)), "corrections": np.zeros((0, 8)), "agent": MAX_UAVS}),
        (StepReport, {"plan_ages": (-1, MAX_TICK), "residual": -1}),
        (PlantState, {"plan_ticks": (-1, -2), "x": np.full(36, -0.0)}),
    ],
)
def test_limits_themselves_are_allowed(kind: type[Message], changes: dict[str, Any]) -> None:
    """The largest and smallest values a field may have are accepted."""
    message = sample(kind, **changes)
    for field, value in changes.items():
        np.testing.assert_array_equal(getattr(message, field), value)


def test_long_values_are_cut_in_the_text() -> None:
    """Long values are shortened in error texts."""
    assert len(refusal(Control, outcome="x" * 100_000)) < 200
    assert len(refusal(Tick, members=["y" * 100_000])) < 200
