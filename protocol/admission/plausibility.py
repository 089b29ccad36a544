"""Plausibility of messages.

Agents and UAVs of the run, possible inputs and states, whatever the present tick is.
"""

import math

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.protocol.wire.errors import MessageError
from transport.protocol.wire.messages import (
    ActualInputs,
    Measurement,
    Message,
    Plan,
    PlantState,
    Roster,
    StepReport,
    Tick,
)
from transport.protocol.wire.node import RunShape

_OFF_UNIT = 0.2  # deviation of a rod direction's length from 1 that sensor noise can cause
# Fields with ids of agents and of UAVs.
_IDS: dict[type[Message], tuple[str, ...]] = {
    Tick: ("members", "answered", "shared"),
    Measurement: ("answered", "shared"),
    Roster: ("agents", "off", "released"),
    StepReport: ("peers",),
    ActualInputs: ("uavs", "cables"),
}


def check_tick(message: Message, first: int, last: int) -> None:
    """Raise MessageError for a message whose tick is not among those from a first to a last one."""
    if message.tick < first:
        raise MessageError(
            "past", f"{message.kind} of tick {message.tick}, expected {first} or later"
        )
    if message.tick > last:
        raise MessageError(
            "future", f"{message.kind} of tick {message.tick}, expected {last} or earlier"
        )


def check_plausible(message: Message, run: RunShape) -> None:
    """Raise MessageError for a message that no process of a run can have sent."""
    check_tick(message, 0, run.ticks - 1)
    for field in _IDS.get(type(message), ()):
        are_uavs = field in ("off", "released", "uavs", "cables")
        known = range(1, run.uavs + 1) if are_uavs else run.owned
        if strangers := [number for number in getattr(message, field) if number not in known]:
            what = "UAVs" if are_uavs else "agents"
            raise MessageError(
                "unknown_agent", f"{field}: expected {what} of this run, got {strangers}"
            )
    match message:
        case Plan():
            _check_states(message, run, state.REPORTS * state.REPORTED, "corrections")
            _check_plan(message, run)
        case Measurement():
            _check_states(message, run, state.SENSED, "payload", "inputs")
        case PlantState() if len(message.plan_ticks) != run.uavs:
            text = f"x: expected a state of {run.uavs} UAVs, got one of {len(message.plan_ticks)}"
            raise MessageError("wrong_shape", text)


def _check_plan(plan: Plan, run: RunShape) -> None:
    ahead = plan.start_tick - plan.tick
    if ahead != run.delay:
        text = f"plan of tick {plan.tick} that starts at tick {plan.start_tick}"
        raise MessageError("past" if ahead < run.delay else "future", text)
    if plan.negotiation >= run.negotiation_iterations:
        text = (
            f"negotiation: expected less than {run.negotiation_iterations}, got {plan.negotiation}"
        )
        raise MessageError("out_of_range", text)
    low, high = run.limits[plan.agent]
    if np.count_nonzero(plan.inputs < low) or np.count_nonzero(plan.inputs > high):
        raise MessageError("outside_limits", f"inputs outside the limits of {plan.sender}")


def _check_states(message: Plan | Measurement, run: RunShape, sensed: int, *others: str) -> None:
    """Check the UAVs, their states, (owned, 12), or numbers of their sensors, (owned, sensed), and other arrays."""
    owned = run.owned.get(message.agent)
    if owned is None:
        raise MessageError(
            "unknown_agent",
            f"{message.kind} of agent {message.agent}, the run has {len(run.owned)}",
        )
    if message.uavs != owned:
        text = (
            f"{message.kind} of UAVs {list(message.uavs)}, agent {message.agent} has {list(owned)}"
        )
        raise MessageError("wrong_uavs", text)
    for field in ("uav_states", *others):
        values: Array = getattr(message, field)
        # The first test takes one pass; the usual case is below.
        if (
            np.vdot(values, values) >= state.LARGEST**2
            and (largest := np.abs(values).max()) > state.LARGEST
        ):
            raise MessageError(
                "out_of_range", f"{field}: expected at most {state.LARGEST:g}, got {largest:g}"
            )
    blocks, expected = message.uav_states, sensed if run.vehicle_sensors else state.PER_UAV
    if blocks.shape[1] != expected:
        raise MessageError(
            "wrong_shape",
            f"uav_states: expected {expected} numbers of a UAV, got {blocks.shape[1]}",
        )
    lengths = [] if run.vehicle_sensors else [math.hypot(*e) for e in blocks[:, state.E].tolist()]
    if any(abs(length - 1.0) > _OFF_UNIT for length in lengths):
        raise MessageError(
            "out_of_range", f"uav_states: expected rod directions of length 1, got {max(lengths):g}"
        )
