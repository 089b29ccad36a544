"""A target given during a run: its message, or the reason why it is refused."""

from dataclasses import replace
from typing import Any

import numpy as np

from transport.model.arrays import Array
from transport.model.path.curves import Curve
from transport.model.path.target_and_stop import LOAD_S, PathTarget
from transport.model.physics.parameters import resting_height
from transport.protocol.scenario.checks.feasibility import ON_GROUND_M
from transport.protocol.scenario.checks.obstacle_margins import first_blocked
from transport.protocol.scenario.sections.limits_on_size import maneuver_ticks
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.path_instants import curve_instants, maneuver_instants
from transport.protocol.scenario.sections.scenario_errors import RequestError
from transport.protocol.scenario.targets.planned_run import PlannedRun
from transport.protocol.scenario.targets.target_timing import (
    Window,
    between,
    fastest_approach,
    fastest_way,
    first_exceeded,
    least_approach_s,
    least_way_s,
    teams_flying,
)

_ROUNDING_M = 1e-9


def target_fields(setup: PlannedRun, section: TargetSection, tick: int) -> dict[str, Any]:
    """Return the fields of the message for a target from a tick on.

    The least duration is compared with the rest of the run before anything is sampled, and the work
    depends on the numbers of way points and phases alone, whatever the distances, speeds and times.

    Raises: RequestError: it cannot be flown.
    """
    period_s = setup.settings.sampling_period_s
    window = Window(since_s=tick * period_s, last_s=(setup.ticks - 1) * period_s)
    if not section.land and not setup.scenario.has_plant:
        last_s = (maneuver_ticks(setup.scenario) - 1) * period_s
        window = replace(window, last_s=last_s, ends="maneuver")
    if section.land:
        section = _with_landing(setup, section, window.since_s)
    points_I = np.array(section.points_m)
    handover_s = LOAD_S if section.land else 0.0

    # What needs no sampling of the path.
    _check_above_ground(setup, points_I, window.since_s)
    _check_in_flight(setup, window.since_s)
    least_s = least_approach_s(setup, section, window) + least_way_s(section)
    window.check(least_s + handover_s)

    # The fastest motion that keeps the limits of the team, within the time left.
    approach = fastest_approach(setup, section, window)
    way = fastest_way(setup, section, window) if len(points_I) > 1 else None
    way_s = 0.0 if way is None else way.duration_s
    window.check(approach.duration_s + way_s + handover_s)

    # Between its points a curve may be deeper than they are.
    if way is not None:
        way_I = points_I[0] + way.path(curve_instants(way), 1)[0]
        _check_above_ground(setup, way_I, window.since_s)

    target = PathTarget(since_s=window.since_s, point_I=points_I[0], approach=approach, way=way)
    _check_formation(setup, target, window)
    _check_obstacles(setup, target)
    fields = _message_fields(tick, points_I, approach, way)
    return {**fields, "lands": section.land, "to": _told(setup, section)}


def _told(setup: PlannedRun, section: TargetSection) -> tuple[int, ...]:
    """Return the agents that are told a target, ascending; none for all."""
    agents = range(1, len(setup.scenario.owned) + 1)
    strangers = [agent for agent in section.to if agent not in agents]
    if strangers:
        raise RequestError(f"to: expected agents 1 to {agents[-1]}, got {strangers[0]}")
    if section.to and setup.scenario.has_vehicles:
        raise RequestError("to: expected none with [vehicles]: their UAVs are told with all agents")
    told = sorted(set(section.to))
    return () if len(told) == len(agents) else tuple(told)


def _with_landing(setup: PlannedRun, section: TargetSection, since_s: float) -> TargetSection:
    """Return a target with the points of its landing: above the place, if one is given, and there.

    Raises: RequestError: the payload is not above it.
    """
    here_I = setup.maneuver.path(np.array([since_s]))[0][0]
    points = [*section.points_m]
    x, y, z = points[-1] if points else here_I.tolist()
    if section.land_at_m is not None:
        x, y = section.land_at_m
        points.append((x, y, z))

    ground_m = setup.scenario.plant.ground_m
    resting_m = resting_height(setup.system, 0.0 if ground_m is None else ground_m)
    if z > resting_m - ON_GROUND_M:
        expected = f"expected a payload above z = {resting_m:g} m, where it would rest"
        raise RequestError(f"land: {expected}, got {z:g} m")
    return section.model_copy(update={"points_m": [*points, (x, y, resting_m)]})


def _check_formation(setup: PlannedRun, target: PathTarget, window: Window) -> None:
    """Check a way during which the formation changes, as it goes on after a target."""
    if target.way is None or setup.scenario.maneuver.reference == "hover":
        return
    led = setup.maneuver.with_target(target)
    duration_s = target.approach.duration_s + target.way.duration_s
    path = led.jets(between(maneuver_instants(led), window.since_s, duration_s))
    if path.shape[-1] == 3:
        return  # without a formation: the way itself has been checked
    problem = first_exceeded(path, teams_flying(setup, window), setup)
    if problem is not None:
        raise RequestError(f"points_m: {problem}")


def _message_fields(
    tick: int, points_I: Array, approach: Curve, way: Curve | None
) -> dict[str, Any]:
    """Return the fields of `messages.Target` but its number and header."""
    times_s = np.zeros(len(points_I))
    if way is not None and way.times_s is not None:
        times_s[1:] = way.times_s
    return {
        "tick": tick,
        "points": points_I,
        "times": times_s,
        "approach_s": approach.duration_s,
        "approach_ramp_s": approach.ramp_s,
        "way_s": 0.0 if way is None else way.duration_s,
        "way_ramp_s": 0.0 if way is None else way.ramp_s,
    }


def _check_above_ground(setup: PlannedRun, points_I: Array, since_s: float) -> None:
    """Check that points are above the lowest place of the payload."""
    lowest_m = _lowest_m(setup, since_s)
    deepest_m = points_I[:, 2].max()
    if deepest_m > lowest_m + _ROUNDING_M:
        expected = f"expected z (down) of at most {lowest_m:g} m"
        raise RequestError(f"points_m: {expected}, got {deepest_m:g}")


def _check_in_flight(setup: PlannedRun, since_s: float) -> None:
    """Check that the payload is not on the ground, and neither takes off nor lands."""
    if setup.scenario.plant.ground_m is None:
        return
    here_I = setup.maneuver.path(np.array([since_s]))[0][0]
    phase = setup.maneuver.phase_at(since_s)
    is_vertical = phase.kind in ("take_off", "land")
    if is_vertical or here_I[2] > _lowest_m(setup, since_s) - ON_GROUND_M:
        raise RequestError(
            f"expected a payload in flight, got phase {phase.name!r} at t = {since_s:.2f} s"
        )


def _lowest_m(setup: PlannedRun, since_s: float) -> float:
    """Return the largest z (down) of the payload, m.

    At rest on the ground; without one z = 0, or as low as the path was at its start or is now.
    """
    ground_m = setup.scenario.plant.ground_m
    if ground_m is not None:
        return resting_height(setup.system, ground_m)
    start_I, here_I = setup.maneuver.path(np.array([0.0, since_s]))[0]
    return max(0.0, float(start_I[2]), float(here_I[2]))


def _check_obstacles(setup: PlannedRun, target: PathTarget) -> None:
    """Check that the way to a target and through its points keeps the margins of obstacles."""
    if not setup.known_obstacles:
        return

    led = setup.with_target(target)
    instants_s = between(
        maneuver_instants(led.maneuver), target.since_s, target.ends_s - target.since_s
    )
    blocked = first_blocked(setup.system, setup.known_obstacles, led.reference.states, instants_s)
    if blocked is not None:
        raise RequestError(f"points_m: {blocked[1]}")
