"""Plausibility of messages: agents and UAVs of the run, possible inputs and states, whatever the present tick is."""

import math
from collections.abc import Collection

import numpy as np

from model import state
from model.arrays import Array
from protocol.wire.message import Message, MessageError
from protocol.wire.messages import ActualInputs, Measurement, Plan, PlantState, Roster, StepReport, Tick
from protocol.wire.run_shape import RunShape

# Deviation of a rod direction's length from 1 that sensor noise can cause.
_OFF_UNIT = 0.2


def check_tick(message: Message, first: int, last: int) -> None:
    """Refuse a message whose tick is not among those from a first to a last one.

    Raises: MessageError: the message is of the past or the future.
    """
    if message.tick < first:
        raise MessageError("past", f"{message.kind} of tick {message.tick}, expected {first} or later")
    if message.tick > last:
        raise MessageError("future", f"{message.kind} of tick {message.tick}, expected {last} or earlier")


def check_plausible(message: Message, run: RunShape) -> None:
    """Refuse a message that no process of a run can have sent.

    Raises: MessageError: with the reason.
    """
    check_tick(message, 0, run.ticks - 1)
    match message:
        case Plan():
            _check_plan(message, run)
        case Measurement():
            _check_owner(message, run)
            _check_agents("answered", message.answered, run)
            _check_agents("shared", message.shared, run)
            _check_size("payload", message.payload)
            _check_states(message.uav_states, run, state.SENSED)
            _check_size("inputs", message.inputs)
            if not run.vehicle_sensors:
                _check_level(message.payload[None, state.THETA0])
            _check_level(message.uav_states[:, state.THETA])
        case Tick():
            _check_agents("members", message.members, run)
            _check_agents("answered", message.answered, run)
            _check_agents("shared", message.shared, run)
        case Roster():
            _check_agents("agents", message.agents, run)
            _check_uavs("off", message.off, run)
        case StepReport():
            _check_agents("peers", message.peers, run)
        case ActualInputs():
            _check_uavs("uavs", message.uavs, run)
            _check_uavs("cables", message.cables, run)
        case PlantState():
            if len(message.plan_ticks) != run.uavs:
                text = f"x: expected a state of {run.uavs} UAVs, got one of {len(message.plan_ticks)}"
                raise MessageError("wrong_shape", text)


def _check_plan(plan: Plan, run: RunShape) -> None:
    _check_owner(plan, run)
    ahead = plan.start_tick - plan.tick
    if ahead != run.delay:
        text = f"plan of tick {plan.tick} that starts at tick {plan.start_tick}"
        raise MessageError("past" if ahead < run.delay else "future", text)
    if plan.negotiation >= run.negotiation_iterations:
        text = f"negotiation: expected less than {run.negotiation_iterations}, got {plan.negotiation}"
        raise MessageError("out_of_range", text)
    low, high = run.limits[plan.agent]
    if np.count_nonzero(plan.inputs < low) or np.count_nonzero(plan.inputs > high):
        raise MessageError("outside_limits", f"inputs outside the limits of {plan.sender}")
    _check_states(plan.uav_states, run, state.REPORTS * state.REPORTED)
    _check_size("corrections", plan.corrections)


def _check_owner(message: Measurement | Plan, run: RunShape) -> None:
    owned = run.owned.get(message.agent)
    if owned is None:
        text = f"{message.kind} of agent {message.agent}, the run has {len(run.owned)}"
        raise MessageError("unknown_agent", text)
    if message.uavs != owned:
        text = f"{message.kind} of UAVs {list(message.uavs)}, agent {message.agent} has {list(owned)}"
        raise MessageError("wrong_uavs", text)


def _check_uavs(field: str, uavs: Collection[int], run: RunShape) -> None:
    if max(uavs, default=0) > run.uavs:
        raise MessageError("out_of_range", f"{field}: expected UAVs of this run, 1 to {run.uavs}, got {max(uavs)}")


def _check_agents(field: str, agents: Collection[int], run: RunShape) -> None:
    strangers = [agent for agent in agents if agent not in run.owned]
    if strangers:
        raise MessageError("unknown_agent", f"{field}: expected agents of this run, got {strangers}")


def _check_states(blocks: Array, run: RunShape, sensed: int) -> None:
    """Refuse impossible states of UAVs, (owned, 12), or numbers of their sensors, (owned, sensed), as the run has."""
    _check_size("uav_states", blocks)
    expected = sensed if run.vehicle_sensors else state.PER_UAV
    if blocks.shape[1] != expected:
        raise MessageError("wrong_shape", f"uav_states: expected {expected} numbers of a UAV, got {blocks.shape[1]}")
    if run.vehicle_sensors:
        return
    lengths = [math.hypot(*e) for e in blocks[:, state.E].tolist()]
    if any(abs(length - 1.0) > _OFF_UNIT for length in lengths):
        raise MessageError("out_of_range", f"uav_states: expected rod directions of length 1, got {max(lengths):g}")


def _check_size(field: str, values: Array) -> None:
    if np.vdot(values, values) < state.LARGEST**2:
        return  # the usual case, in one pass
    largest = float(np.abs(values).max(initial=0.0))
    if largest > state.LARGEST:
        raise MessageError("out_of_range", f"{field}: expected at most {state.LARGEST:g}, got {largest:g}")


def _check_level(angles: Array) -> None:
    """Refuse attitudes, (rows, 3), rad, at which the plant would have reported divergence before measuring them."""
    steepest = max((abs(angle) for row in angles[:, :2].tolist() for angle in row), default=0.0)
    if steepest >= math.pi / 2.0:
        raise MessageError("out_of_range", f"roll and pitch: expected less than 90 deg, got {math.degrees(steepest):g}")
