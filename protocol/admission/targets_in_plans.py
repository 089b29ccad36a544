"""Targets that travel with plans: those told to some agents, and those that agents make of what they see.

They travel as the bytes of `target` messages.
An agent that knows such a target puts it into its plans, and an agent that hears it does the same, so that it
goes round a cut link. `incarnation` and `sequence` of a carried message are 0: it belongs to no stream.
"""

from functools import lru_cache

import numpy as np

from transport.model.state import LARGEST
from transport.protocol.wire.codec import decode
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.message_form import MAX_TARGETS
from transport.protocol.wire.messages import Plan, Target
from transport.protocol.wire.names import AGENT, COORDINATOR, agent_name, role_of
from transport.protocol.wire.node_interface import RunShape

# Tick and number of a target: the newest of a run is the one with the largest, for all agents. Numbers of
# targets that an agent makes, one at a tick at most, are above those of the coordinator.
Place = tuple[int, int]

_ROUNDING_S = 1e-6


def place_of(target: Target) -> Place:
    """Return the place of a target in the order in which all agents follow targets."""
    return target.tick, target.number


@lru_cache(maxsize=256)
def _target_in(data: bytes) -> Target:
    """Return the target in some bytes. Raises: MessageError: there is none."""
    message = decode(data)
    senders = COORDINATOR, AGENT
    if not isinstance(message, Target) or role_of(message.sender) not in senders:
        expected = "expected targets of the coordinator or an agent"
        text = f"targets: {expected}, got {message.kind} of {message.sender}"
        raise MessageError("wrong_sender", text)
    return message


def is_of_sight(target: Target) -> bool:
    """Return whether an agent has made a target, of what it sees: only these brake."""
    return target.brakes


def number_of_sight(agent: int) -> int:
    """Return the number of each target that an agent, 1-based, makes."""
    return MAX_TARGETS + agent


def carried_by(plan: Plan) -> list[Target]:
    """Return the targets that a plan carries, oldest first. Raises: MessageError: one is none."""
    return [_target_in(data) for data in plan.targets]


def check_carried(plan: Plan, run: RunShape) -> None:
    """Refuse a plan with a target that no agent of a run can have been told by its tick.

    Raises: MessageError: with what was expected and what came.
    """
    before = (-1, 0)
    for target in carried_by(plan):
        if target.tick > plan.tick:
            text = f"targets: expected those told until tick {plan.tick}, got tick {target.tick}"
            raise MessageError("future", text)
        if place_of(target) <= before:
            raise MessageError("out_of_range", "targets: expected each once, oldest first")
        before = place_of(target)
        strangers = [agent for agent in target.to if agent not in run.owned]
        if strangers or not target.to:
            text = f"targets: expected one told to agents of this run, got {list(target.to)}"
            raise MessageError("unknown_agent", text)
        _check_maker(target, run)
        _check_confirmation(target, plan, run)
        _check_motion(target, run)


def _check_maker(target: Target, run: RunShape) -> None:
    """Refuse a target that neither the coordinator nor an agent that sees makes under its number."""
    if target.brakes != (target.sender != COORDINATOR):
        text = f"targets: expected braking in those of agents only, got one of {target.sender}"
        raise MessageError("wrong_sender", text)
    if target.sender == COORDINATOR:
        if target.number > MAX_TARGETS:
            text = f"targets: expected numbers of at most {MAX_TARGETS}, got {target.number}"
            raise MessageError("out_of_range", text)
        return
    if not run.sights:
        text = f"targets: expected those of the coordinator without obstacles to see, got one of {target.sender}"
        raise MessageError("wrong_sender", text)
    agent = target.number - MAX_TARGETS
    if target.to != (agent,) or target.sender != agent_name(agent):
        text = f"targets: expected a number, to and sender of one agent, got {target.number} of {target.sender}"
        raise MessageError("unknown_agent", text)


def _check_confirmation(target: Target, plan: Plan, run: RunShape) -> None:
    """Refuse agents and ticks of a confirmation that cannot be, and any where the run has none."""
    if not run.confirms and (target.informed or target.begins):
        text = "targets: expected no confirmations with controller.targets = eager"
        raise MessageError("wrong_shape", text)
    strangers = [agent for agent in target.informed if agent not in run.owned]
    if strangers:
        text = f"targets: expected agents of this run that have it, got {strangers}"
        raise MessageError("unknown_agent", text)
    if len(set(target.informed)) < len(target.informed):
        raise MessageError("out_of_range", "targets: expected each agent that has it once")

    ticks = [*target.got, *([target.begins] if target.begins else [])]
    if ticks and not target.tick <= min(ticks) <= max(ticks) <= plan.tick:
        text = f"targets: expected ticks from {target.tick} to {plan.tick}, got {ticks}"
        raise MessageError("future" if max(ticks) > plan.tick else "past", text)


def _check_motion(target: Target, run: RunShape) -> None:
    """Refuse points beyond any position, and times that are none within the run."""
    if np.abs(target.points).max() > LARGEST:
        largest = np.abs(target.points).max()
        text = f"targets: expected points of at most {LARGEST:g} m, got {largest:g}"
        raise MessageError("out_of_range", text)

    stages_s = [(target.approach_s, target.approach_ramp_s)]
    if len(target.points) > 1:
        stages_s.append((target.way_s, target.way_ramp_s))
        if not np.diff(target.points, axis=0).any(axis=1).all():
            raise MessageError("out_of_range", "targets: expected points that differ")
    for duration_s, ramp_s in stages_s:
        if not 0.0 < ramp_s <= duration_s / 2.0 + _ROUNDING_S:
            text = f"targets: expected a ramp of at most half of {duration_s:g} s, got {ramp_s:g} s"
            raise MessageError("out_of_range", text)

    times_s = target.times
    rises = len(times_s) > 1 and (np.diff(times_s) > 0.0).all() and times_s[0] == 0.0
    if times_s.any() and not (rises and abs(times_s[-1] - target.way_s) <= _ROUNDING_S):
        raise MessageError("out_of_range", "targets: expected times that rise from 0 to way_s")

    left_s = (run.ticks - target.tick) * run.period_s
    ends_s = target.approach_s + (target.way_s if len(target.points) > 1 else 0.0)
    if ends_s > left_s + _ROUNDING_S:
        text = f"targets: expected an end within the {left_s:g} s that are left, got {ends_s:g} s"
        raise MessageError("future", text)
