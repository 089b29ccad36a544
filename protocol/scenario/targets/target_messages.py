"""Targets given during a run: messages of the coordinator, each of which makes a new reference."""

from collections.abc import Mapping
from operator import itemgetter
from typing import Any

from transport.model.path.target_and_stop import PathTarget
from transport.protocol.scenario.sections.lockstep_and_realtime_section import first_tick
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import RequestError, requested
from transport.protocol.scenario.targets.planned_run import PlannedRun
from transport.protocol.scenario.targets.target_checks import target_fields
from transport.protocol.scenario.targets.target_timing import spline, straight
from transport.protocol.wire import messages
from transport.protocol.wire.message_form import MAX_TARGETS
from transport.protocol.wire.names import COORDINATOR
from transport.protocol.wire.outbox import Outbox


def target_of(message: messages.Target, period_s: float, *, has_ground: bool) -> PathTarget:
    """Return the target in a message, at a sampling period, s; without a ground none lands."""
    point_I = message.points[0]
    further_I = message.points[1:] - point_I

    way = None
    if len(further_I):
        times_s = message.times[1:].tolist() if message.times.any() else None
        way = spline(further_I, message.way_s, message.way_ramp_s, times_s)

    return PathTarget(
        since_s=message.first_tick * period_s,
        point_I=point_I,
        approach=straight(message.approach_s, message.approach_ramp_s),
        way=way,
        brakes=message.brakes,
        way_since_s=message.begins * period_s if message.brakes else 0.0,
        lands=message.lands and has_ground,
    )


def scripted(setup: PlannedRun) -> list[tuple[int, TargetSection]]:
    """Return the targets of a scenario with their ticks, in the order of time."""
    period_s = setup.settings.sampling_period_s
    sections = setup.scenario.maneuver.target
    timed = [(first_tick(section.at_s, period_s), section) for section in sections]
    return sorted(timed, key=itemgetter(0))


class TargetTiming:
    """Timing of targets one after the other: each from the path that leads to those before."""

    def __init__(self, setup: PlannedRun) -> None:
        self._setup = setup  # with the targets so far

    def fields(self, wanted: TargetSection | Mapping[str, Any], tick: int) -> dict[str, Any]:
        """Return the fields of the message of a target from a tick on: a section, or a request of one.

        Raises: RequestError: the request is not valid, or the team cannot fly to the target.
        """
        if not isinstance(wanted, TargetSection):
            wanted = requested(TargetSection, dict(wanted))
        return target_fields(self._setup, wanted, tick)

    def follow(self, message: messages.Target) -> None:
        """Let the path lead to a target that is told."""
        self._setup = self._setup.after([message])


def check_scripted(setup: PlannedRun) -> None:
    """Check that the targets of a scenario can be flown one after the other.

    Raises: RequestError: one cannot.
    """
    timed = scripted(setup)
    if len(timed) > MAX_TARGETS:
        raise RequestError(f"expected at most {MAX_TARGETS} targets in a run, got {len(timed)}")

    out = Outbox(COORDINATOR, 0)
    timing = TargetTiming(setup)
    for number, (tick, section) in enumerate(timed, start=1):
        timing.follow(out.stamp(messages.Target, number=number, **timing.fields(section, tick)))
