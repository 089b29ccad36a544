"""Hypothesis strategies: any valid message of any kind."""

from typing import get_args

from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from hypothesis.strategies import SearchStrategy

from model.arrays import Array
from protocol.wire.messages import (
    MAX_NEGOTIATION_ITERATIONS,
    MAX_TICK,
    MAX_UAVS,
    STAGES,
    Control,
    FaultNote,
    FaultOrigin,
    LinkChange,
    Measurement,
    Message,
    Outcome,
    Plan,
    PlanStatus,
    PlantState,
    Reason,
    Rejected,
    Roster,
    StepReport,
    Tick,
)

# Sizes that keep an example cheap; larger ones take the same path.
_UAVS, _STEPS = 4, 5

_agent = st.integers(1, MAX_UAVS)
_count = st.integers(0, MAX_TICK)
_age = st.integers(-1, MAX_TICK)
_text = st.text(max_size=40)
_number = st.floats(allow_nan=False, allow_infinity=False)
_ids = st.lists(_agent, max_size=_UAVS, unique=True).map(sorted)
_name = st.sampled_from(["coordinator", "plant", "recorder"]) | _agent.map(lambda agent: f"agent{agent}")
_head = {
    "sender": _name,
    "incarnation": _count,
    "sequence": _count,
    "tick": _count,
}
_status = st.sampled_from(get_args(PlanStatus))


def _array(*shape: int) -> SearchStrategy[Array]:
    return arrays.arrays("float64", shape, elements=_number)


def _listed(length: int, entries: SearchStrategy[int]) -> SearchStrategy[list[int]]:
    return st.lists(entries, min_size=length, max_size=length)


ticks = st.builds(
    Tick, members=_ids, answered=_ids, shared=_ids, roster=_count, late_ns=_count, overrun_ns=_count, **_head
)
rosters = _ids.flatmap(
    lambda ids: st.builds(
        Roster,
        version=_count,
        agents=st.just(ids),
        incarnations=_listed(len(ids), _count),
        off=st.just(ids),
        released=st.just(ids[1:]),
        reason=_text,
        **_head,
    )
)
link_changes = st.builds(
    LinkChange,
    number=st.integers(1, MAX_TICK),
    source=_name | st.just(""),
    target=_name | st.just(""),
    settings=_text,
    **_head,
)
measurements = _ids.flatmap(
    lambda ids: st.builds(
        Measurement,
        agent=_agent,
        answered=_ids,
        shared=_ids,
        roster=_count,
        payload=_array(12),
        uavs=st.just(ids),
        uav_states=_array(len(ids), 12),
        inputs=_array(len(ids), 4),
        **_head,
    )
)
plans = st.tuples(_ids, st.integers(1, _STEPS), st.booleans()).flatmap(
    lambda drawn: st.builds(
        Plan,
        agent=_agent,
        start_tick=_count,
        negotiation=st.integers(0, MAX_NEGOTIATION_ITERATIONS - 1),
        shared=st.booleans(),
        uavs=st.just(drawn[0]),
        uav_states=_array(len(drawn[0]), 12),
        inputs=_array(drawn[1], 4 * len(drawn[0])),
        corrections=_array(drawn[1] * drawn[2], 4 * len(drawn[0])),
        status=_status,
        **_head,
    )
)
reports = _ids.flatmap(
    lambda ids: st.builds(
        StepReport,
        agent=_agent,
        status=_status,
        solver=_text,
        fallback=st.booleans(),
        iterations=_count,
        residual=_number,
        peers=st.just(ids),
        plan_ages=_listed(len(ids), _age),
        state_ages=_listed(len(ids), _age),
        measurement_age=_age,
        delivered=_count,
        lost=_count,
        late=_count,
        force=_array(3),
        times_ms=_array(len(STAGES)),
        **_head,
    )
)
plant_states = st.integers(0, _UAVS).flatmap(
    lambda N: st.builds(
        PlantState,
        x=_array(12 + 12 * N),
        u=_array(4 * N),
        plan_ticks=_listed(N, st.integers(-3, MAX_TICK)),
        local_error=_number,
        diverged=_text,
        **_head,
    )
)
fault_notes = st.builds(FaultNote, target=_name, what=_text, origin=st.sampled_from(get_args(FaultOrigin)), **_head)
rejections = st.builds(
    Rejected,
    offender=_text,
    reason=st.sampled_from(get_args(Reason)),
    count=st.integers(1, MAX_TICK),
    example=_text,
    **_head,
)
controls = st.builds(
    Control, outcome=st.sampled_from(get_args(Outcome)), reason=_text, exit_code=st.integers(0, 255), **_head
)

messages: SearchStrategy[Message] = st.one_of(
    ticks, rosters, link_changes, measurements, plans, reports, plant_states, fault_notes, rejections, controls
)
