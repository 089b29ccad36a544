"""Plausibility of messages: agents and UAVs of the run, possible inputs and states, and the tick."""

import math
from collections.abc import Collection

import numpy as np

from model import state
from model.arrays import Array
from protocol.scenario.setup import Setup
from protocol.wire.messages import (
    ActualInputs,
    Measurement,
    Message,
    MessageError,
    Plan,
    PlantState,
    Roster,
    StepReport,
    Tick,
)
from protocol.wire.names import agent_name

# Deviation of a rod direction's length from 1 that sensor noise can cause.
_OFF_UNIT = 0.2


def window(setup: Setup) -> int:
    """Return how many ticks another process may be ahead of this one, or behind it.

    In lockstep one. In real time twice the number of ticks an agent may miss before it is taken off the roster.
    """
    clock = setup.scenario.clock
    if clock.mode == "lockstep":
        return 1
    return 2 * math.ceil(clock.barrier_timeout_s * clock.speed / setup.settings.sampling_period_s)


def check_moment(message: Message, first: int, last: int) -> None:
    """Refuse a message whose tick is not among those from a first to a last one.

    Raises: MessageError: the message is of the past or the future.
    """
    if message.tick < first:
        raise MessageError("past", f"{message.kind} of tick {message.tick}, expected {first} or later")
    if message.tick > last:
        raise MessageError("future", f"{message.kind} of tick {message.tick}, expected {last} or earlier")


class Plausibility:
    """Checks of messages that need the run alone, not the present tick."""

    def __init__(self, setup: Setup) -> None:
        clock, limits = setup.scenario.clock, setup.settings.limits
        self._agents = frozenset(setup.agents)
        self._ticks = setup.ticks
        self._negotiation_iterations = setup.scenario.controller.negotiation_iterations
        self._delay = 1 if clock.next_tick else 0
        self._states = len(setup.hover.x)
        self._N = setup.system.N
        self._uavs = {agent: tuple(uav + 1 for uav in owned) for agent, owned in enumerate(setup.owned, start=1)}
        self._limits = {agent: (limits.lower(len(uavs)), limits.upper(len(uavs))) for agent, uavs in self._uavs.items()}

    def check(self, message: Message) -> None:
        """Refuse a message that no process of this run can have sent.

        Raises: MessageError: with the reason.
        """
        check_moment(message, 0, self._ticks - 1)
        match message:
            case Plan():
                self._check_plan(message)
            case Measurement():
                self._check_owner(message, message.agent, message.uavs)
                self._check_others("answered", message.answered)
                self._check_others("shared", message.shared)
                _check_size("payload", message.payload)
                _check_states(message.uav_states)
                _check_size("inputs", message.inputs)
                _check_level(message.payload[None, state.THETA0])
                _check_level(message.uav_states[:, state.THETA])
            case Tick():
                self._check_others("members", message.members)
                self._check_others("answered", message.answered)
                self._check_others("shared", message.shared)
            case Roster():
                self._check_others("agents", message.agents)
                self._check_uavs("off", message.off)
            case StepReport():
                self._check_others("peers", message.peers)
            case ActualInputs():
                self._check_uavs("uavs", message.uavs)
            case PlantState():
                if len(message.x) != self._states:
                    raise MessageError("wrong_shape", f"x: expected {self._states} numbers, got {len(message.x)}")

    def _check_plan(self, plan: Plan) -> None:
        if plan.sender != agent_name(plan.agent):
            raise MessageError("wrong_sender", f"plan of agent {plan.agent} from {plan.sender}")
        self._check_owner(plan, plan.agent, plan.uavs)
        ahead = plan.start_tick - plan.tick
        if ahead != self._delay:
            text = f"plan of tick {plan.tick} that starts at tick {plan.start_tick}"
            raise MessageError("past" if ahead < self._delay else "future", text)
        if plan.negotiation >= self._negotiation_iterations:
            raise MessageError(
                "out_of_range",
                f"negotiation: expected less than {self._negotiation_iterations}, got {plan.negotiation}",
            )
        low, high = self._limits[plan.agent]
        if np.count_nonzero(plan.inputs < low) or np.count_nonzero(plan.inputs > high):
            raise MessageError("outside_limits", f"inputs outside the limits of {plan.sender}")
        _check_states(plan.uav_states)
        _check_size("corrections", plan.corrections)

    def _check_owner(self, message: Message, agent: int, uavs: tuple[int, ...]) -> None:
        owned = self._uavs.get(agent)
        if owned is None:
            raise MessageError("unknown_agent", f"{message.kind} of agent {agent}, the run has {len(self._uavs)}")
        if uavs != owned:
            raise MessageError("wrong_uavs", f"{message.kind} of UAVs {list(uavs)}, agent {agent} has {list(owned)}")

    def _check_uavs(self, field: str, uavs: Collection[int]) -> None:
        if max(uavs, default=0) > self._N:
            raise MessageError("out_of_range", f"{field}: expected UAVs of this run, 1 to {self._N}, got {max(uavs)}")

    def _check_others(self, field: str, agents: Collection[int]) -> None:
        if not self._agents.issuperset(agents):
            strangers = sorted(set(agents) - self._agents)
            raise MessageError("unknown_agent", f"{field}: expected agents of this run, got {strangers}")


def _check_states(blocks: Array) -> None:
    """Refuse impossible states of UAVs, (owned, 12)."""
    _check_size("uav_states", blocks)
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
