"""Hypothesis strategies: any valid message or bundle of any kind, drawn from the types of its fields."""

from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from hypothesis.strategies import DrawFn, SearchStrategy

from protocol.wire.fields import (
    MAX_KEY,
    MAX_REFUSALS,
    Age,
    Agent,
    Ages,
    Count,
    Counts,
    End,
    Finite,
    Flag,
    Ids,
    KeyEnds,
    Name,
    Number,
    Parts,
    Refusals,
    Shape,
    Text,
    checks,
)
from protocol.wire.messages import (
    BUNDLES,
    KINDS,
    MAX_NEGOTIATION_ITERATIONS,
    MAX_TICK,
    MAX_UAVS,
    Answer,
    Bundle,
    Control,
    Message,
    Plan,
    PlantState,
    Roster,
    StepReport,
    agent_name,
)
from protocol.wire.names import COORDINATOR, PLANT, RECORDER
from tests.support.samples import array_of

T = TypeVar("T")

# Sizes that keep an example fast; larger sizes take the same code path.
_UAVS, _STEPS, _PARTS = 4, 5, 4

_agent = st.integers(1, MAX_UAVS)
_count = st.integers(0, MAX_TICK)
_age = st.integers(-1, MAX_TICK)
_text = st.text(max_size=40)
_number = st.floats(allow_nan=False, allow_infinity=False)
_name = st.sampled_from([COORDINATOR, PLANT, RECORDER]) | _agent.map(agent_name)

_BY_TYPE: dict[Any, SearchStrategy[Any]] = {
    Name: _name,
    End: _name | st.just(""),
    Count: _count,
    Number: st.integers(1, MAX_TICK),
    Refusals: st.integers(1, MAX_REFUSALS),
    Age: _age,
    Agent: _agent,
    Ids: st.lists(_agent, max_size=_UAVS, unique=True).map(sorted),
    Counts: st.lists(_count, max_size=_UAVS),
    Ages: st.lists(_age, max_size=_UAVS),
    Finite: _number,
    Flag: st.booleans(),
    Text: _text,
    KeyEnds: st.lists(st.text(st.characters(codec="ascii"), max_size=MAX_KEY), max_size=_PARTS),
    Parts: st.lists(st.binary(max_size=40), max_size=_PARTS),
}

# Fields with their own range.
_OWN: dict[tuple[type[Message], str], SearchStrategy[Any]] = {
    (Plan, "negotiation"): st.integers(0, MAX_NEGOTIATION_ITERATIONS - 1),
    (PlantState, "plan_ticks"): st.lists(st.integers(-3, MAX_TICK), max_size=_UAVS),
    (Control, "exit_code"): st.integers(0, 255),
    (Answer, "keys"): st.lists(st.sampled_from(("plan/1", "unshared/2", "report/3")), max_size=2, unique=True),
}


def _field(kind: type[Message], field: str) -> SearchStrategy[Any]:
    if (kind, field) in _OWN:
        return _OWN[kind, field]
    hint = get_type_hints(kind, include_extras=True)[field]
    return st.sampled_from(get_args(hint)) if get_origin(hint) is Literal else _BY_TYPE[hint]


def _relate(draw: DrawFn, kind: type[Message], values: dict[str, Any]) -> None:
    """Replace the lists whose lengths depend on another field."""

    def listed(like: str, entries: SearchStrategy[T]) -> list[T]:
        return draw(st.lists(entries, min_size=len(values[like]), max_size=len(values[like])))

    if kind is Roster:
        values |= {"incarnations": listed("agents", _count), "released": values["off"][1:]}
    if issubclass(kind, Bundle):
        values |= {"parts": listed("keys", st.binary(max_size=40))}
    if kind is StepReport:
        values |= {"plan_ages": listed("peers", _age), "state_ages": listed("peers", _age)}


@st.composite
def _message(draw: DrawFn, kind: type[Message]) -> Message:
    table = checks(kind)
    values = {field: draw(_field(kind, field)) for field, check in table if not isinstance(check, Shape)}
    _relate(draw, kind, values)
    rows = draw(st.integers(1, _STEPS))
    for field, check in table:
        if isinstance(check, Shape):
            has_rows = field != "corrections" or draw(st.booleans())
            shape = array_of(check, values, rows if has_rows else 0)
            values[field] = draw(arrays.arrays("float64", shape, elements=_number))
    return kind(**values)


messages: SearchStrategy[Message] = st.one_of([_message(kind) for kind in KINDS.values()])
bundles: SearchStrategy[Message] = st.one_of([_message(kind) for kind in BUNDLES.values()])
