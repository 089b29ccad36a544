"""Targets given during a run: messages of the coordinator, each of which makes a new reference."""

from operator import itemgetter

from transport.model.target import Target
from transport.protocol.scenario.sections.clock_section import first_tick
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import RequestError
from transport.protocol.scenario.targets.planned_run import PlannedRun
from transport.protocol.scenario.targets.target_timing import spline, straight, target_fields
from transport.protocol.wire import messages
from transport.protocol.wire.errors import MessageError
from transport.protocol.wire.names import COORDINATOR, agent_name
from transport.protocol.wire.node_interface import Outbox


def target_of(message: messages.Target, period_s: float, *, has_ground: bool) -> Target:
    """Return the target in a message, at a sampling period, s; without a ground none lands."""
    point_I = message.points[0]
    further_I = message.points[1:] - point_I

    way = None
    if len(further_I):
        times_s = message.times[1:].tolist() if message.times.any() else None
        way = spline(further_I, message.way_s, message.way_ramp_s, times_s)

    return Target(
        since_s=message.first_tick * period_s,
        point_I=point_I,
        approach=straight(message.approach_s, message.approach_ramp_s),
        way=way,
        lands=message.lands and has_ground,
    )


def check_target(count: int, message: messages.Target) -> None:
    """Raise MessageError for a target that is neither the next one after a count nor a repeated one."""
    if message.number > count + 1:
        raise MessageError("future", f"target {message.number} after {count}")


def target_in_words(message: messages.Target) -> str:
    """Return a target in words."""
    x, y, z = message.points[-1 if message.lands else 0].tolist()
    told = f", told to {', '.join(map(agent_name, message.to))}" if message.to else ""
    return f"{'landing' if message.lands else 'target'} ({x:g}, {y:g}, {z:g}) m{told}"


def scripted(setup: PlannedRun) -> list[tuple[int, TargetSection]]:
    """Return the targets of a scenario with their ticks, in the order of time."""
    period_s = setup.settings.sampling_period_s
    sections = setup.scenario.maneuver.target
    timed = [(first_tick(section.at_s, period_s), section) for section in sections]
    return sorted(timed, key=itemgetter(0))


def check_scripted(setup: PlannedRun) -> None:
    """Check that the targets of a scenario can be flown one after the other.

    Raises: RequestError: one cannot.
    """
    timed = scripted(setup)
    if len(timed) > messages.MAX_TARGETS:
        raise RequestError(
            f"expected at most {messages.MAX_TARGETS} targets in a run, got {len(timed)}"
        )

    out = Outbox(COORDINATOR, 0)
    for number, (tick, section) in enumerate(timed, start=1):
        numbers = target_fields(setup, section, tick)
        message = out.stamp(messages.Target, number=number, **numbers)
        setup = setup.after([message])
