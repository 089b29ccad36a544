"""Time-independent plausibility of messages: agents and UAVs of the run, inputs, states."""

import math

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.protocol.admission.targets_in_plans import check_carried
from transport.protocol.admission.told_changes import changes_in
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.message_form import ENDLESS_M, MAX_SOLIDS
from transport.protocol.wire.messages import (
    ActualInputs,
    Airtime,
    Measurement,
    Message,
    Plan,
    PlantState,
    Roster,
    StepReport,
    Target,
    Tick,
    VehicleStatus,
)
from transport.protocol.wire.node_interface import RunShape

_OFF_UNIT = 0.2  # deviation of a rod direction's length from 1 that sensor noise can cause
# Fields with ids of agents and of UAVs.
_IDS: dict[type[Message], tuple[str, ...]] = {
    Tick: ("members", "answered", "shared"),
    Measurement: ("answered", "shared"),
    Target: ("to",),
    Roster: ("agents", "off", "released"),
    StepReport: ("peers",),
    ActualInputs: ("uavs", "cables"),
    Airtime: ("agents",),
}
_IDS_OF_UAVS = ("off", "released", "uavs", "cables")


def check_tick(message: Message, first: int, last: int) -> None:
    """Raise MessageError for a message whose tick is not among those from a first to a last one."""
    if message.tick < first:
        text = f"{message.kind} of tick {message.tick}, expected {first} or later"
        raise MessageError("past", text)
    if message.tick > last:
        text = f"{message.kind} of tick {message.tick}, expected {last} or earlier"
        raise MessageError("future", text)


def check_plausible(message: Message, run: RunShape) -> None:
    """Raise MessageError for a message that no process of a run can have sent."""
    check_tick(message, 0, run.ticks - 1)
    for field in _IDS.get(type(message), ()):
        _check_ids(message, field, run)
    match message:
        case Plan():
            _check_states(message, run, state.REPORTS * state.REPORTED, "corrections")
            _check_plan(message, run)
            check_carried(message, run)
        case Measurement():
            _check_states(message, run, state.SENSED, "payload", "inputs")
            if message.missing and not run.vehicle_sensors:
                text = f"missing: expected none without sensors of vehicles, got {message.missing}"
                raise MessageError("wrong_shape", text)
            _check_seen(message.seen, run)
        case Airtime() if message.receivers != tuple(run.owned):
            text = f"receivers: expected all agents of this run, got {list(message.receivers)}"
            raise MessageError("unknown_agent", text)
        case VehicleStatus() if message.changes:
            for change in changes_in(message):
                check_plausible(change, run)
        case PlantState() if len(message.plan_ticks) != run.uavs:
            text = f"x: expected a state of {run.uavs} UAVs, got one of {len(message.plan_ticks)}"
            raise MessageError("wrong_shape", text)


def _check_ids(message: Message, field: str, run: RunShape) -> None:
    """Refuse ids of agents or UAVs that the run has not."""
    are_uavs = field in _IDS_OF_UAVS
    ids = range(1, run.uavs + 1) if are_uavs else run.owned
    strangers = [number for number in getattr(message, field) if number not in ids]
    if strangers:
        whose = "UAVs" if are_uavs else "agents"
        text = f"{field}: expected {whose} of this run, got {strangers}"
        raise MessageError("unknown_agent", text)


def _check_seen(seen: Array, run: RunShape) -> None:
    """Refuse solids of no obstacle, of impossible sizes, or too many of them."""
    if len(seen) > (MAX_SOLIDS if run.sights else 0):
        expected = (
            f"at most {MAX_SOLIDS}" if run.sights else "none in a run without obstacles to see"
        )
        raise MessageError("out_of_range", f"seen: expected {expected}, got {len(seen)}")
    for row in seen:
        number, *others = row.tolist()
        sizes = others[4:]
        is_number = number >= 1.0 and number == int(number)
        if not is_number or min(sizes) < 0.0 or max(map(abs, others)) > ENDLESS_M:
            expected = f"a number from 1, and sizes from 0 to {ENDLESS_M:g}"
            raise MessageError("out_of_range", f"seen: expected {expected}, got {row.tolist()}")


def _check_plan(plan: Plan, run: RunShape) -> None:
    """Refuse a plan with a wrong start, too many iterations, or impossible inputs."""
    ahead = plan.start_tick - plan.tick
    if ahead != run.delay:
        text = f"plan of tick {plan.tick} that starts at tick {plan.start_tick}"
        raise MessageError("past" if ahead < run.delay else "future", text)

    iterations = run.negotiation_iterations
    if plan.negotiation >= iterations:
        text = f"negotiation: expected less than {iterations}, got {plan.negotiation}"
        raise MessageError("out_of_range", text)

    low, high = run.limits[plan.agent]
    if np.count_nonzero(plan.inputs < low) or np.count_nonzero(plan.inputs > high):
        raise MessageError("outside_limits", f"inputs outside the limits of {plan.sender}")


def _check_states(message: Plan | Measurement, run: RunShape, sensed: int, *others: str) -> None:
    """Refuse wrong UAVs, numbers of them, and other arrays that are out of range.

    The numbers of a UAV are its states, (owned, 12), or those of its sensors, (owned, sensed).
    """
    owned = run.owned.get(message.agent)
    if owned is None:
        text = f"{message.kind} of agent {message.agent}, the run has {len(run.owned)}"
        raise MessageError("unknown_agent", text)
    if message.uavs != owned:
        given = f"{message.kind} of UAVs {list(message.uavs)}"
        raise MessageError("wrong_uavs", f"{given}, agent {message.agent} has {list(owned)}")
    for field in ("uav_states", *others):
        _check_size(field, getattr(message, field))

    expected = sensed if run.vehicle_sensors else state.PER_UAV
    numbers = message.uav_states.shape[1]
    if numbers != expected:
        text = f"uav_states: expected {expected} numbers of a UAV, got {numbers}"
        raise MessageError("wrong_shape", text)
    if not run.vehicle_sensors:
        _check_rods(message.uav_states)


def _check_size(field: str, values: Array) -> None:
    """Refuse numbers beyond any state."""
    # Most arrays need this one pass only.
    if np.vdot(values, values) < state.LARGEST**2:
        return
    largest = np.abs(values).max()
    if largest > state.LARGEST:
        text = f"{field}: expected at most {state.LARGEST:g}, got {largest:g}"
        raise MessageError("out_of_range", text)


def _check_rods(uav_states: Array) -> None:
    """Refuse rod directions, |e| = 1, whose length no sensor noise explains."""
    lengths = [math.hypot(*e) for e in uav_states[:, state.E].tolist()]
    worst = max(lengths, key=lambda length: abs(length - 1.0))
    if not abs(worst - 1.0) <= _OFF_UNIT:
        text = f"uav_states: expected rod directions of length 1, got {worst:g}"
        raise MessageError("out_of_range", text)
