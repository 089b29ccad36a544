"""Timing of a target given during a run: the fastest approach and way that the team can fly."""

from dataclasses import dataclass, replace

import numpy as np

from transport.model.arrays import Array
from transport.model.path.curves import ORDERS, Curve
from transport.model.path.target_and_stop import PathTarget
from transport.model.physics.parameters import ParameterError
from transport.protocol.scenario.checks.feasibility import (
    RemainingTeam,
    exceeded,
    least_slowing,
    remaining_teams,
)
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.path_instants import (
    WayPointError,
    check_way_points,
    curve_instants,
    maneuver_instants,
)
from transport.protocol.scenario.sections.scenario_errors import RequestError
from transport.protocol.scenario.targets.planned_run import PlannedRun

# Largest speed where none is given: in flight, and on a way that ends on the ground.
SPEED_MPS, DESCENT_MPS = 1.0, 0.5

# Time of speeding up of an approach that is tried first, the factor from one to the next, and the
# longest one.
_SHORTEST_RAMP_S = 2.0
_LONGER = 1.25
_LONGEST_RAMP_S = 64.0 * _SHORTEST_RAMP_S

# That of the curve through further points: as quick as the quickest approach, until the curve is
# slowed as a whole.
_WAY_RAMP_S = _SHORTEST_RAMP_S


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """Time that is left for a target."""

    since_s: float  # instant from which on the path changes
    last_s: float  # last sampling instant of the run, or of the maneuver where a landing follows it
    ends: str = "run"  # what ends then

    def check(self, duration_s: float) -> None:
        """Raise RequestError for a motion that does not end within it."""
        ends_s = self.since_s + duration_s
        if ends_s > self.last_s:
            expected = (
                f"expected a target before the end of the {self.ends} at t = {self.last_s:.2f} s"
            )
            raise RequestError(f"{expected}, got {ends_s:.2f} s")


def spline(
    further_I: Array, duration_s: float, ramp_s: float, times_s: list[float] | None
) -> Curve:
    """Return the curve through points relative to the target, (k, 3), m, at times or a speed."""
    return Curve(
        kind="spline",
        duration_s=duration_s,
        ramp_s=ramp_s,
        points_I=further_I.tolist(),
        times_s=times_s,
    )


def way_through(further_I: Array, speed_mps: float) -> Curve:
    """Return the curve through points relative to the target, (k, 3), m, at a largest speed.

    Raises: WayPointError: no curve passes them.
    """
    # Largest speed = max |p'| s', with s' = 1 / (T - t_r) in cruise: T = max |p'| / v + t_r, (65).
    shape = spline(further_I, 2.0 * _WAY_RAMP_S, _WAY_RAMP_S, None)  # with any timing
    check_way_points(shape)
    return replace(shape, duration_s=_ramped_s(shape.fastest(), speed_mps, _WAY_RAMP_S))


def straight(duration_s: float, ramp_s: float) -> Curve:
    """Return the curve of length 1 whose share of the way is that of the target in the path."""
    return Curve(kind=None, duration_s=duration_s, ramp_s=ramp_s, size_I=(1.0, 0.0, 0.0))


def _ramped_s(length_m: float, speed_mps: float, ramp_s: float) -> float:
    """Return the duration of a way with ramps at both ends and a largest speed, s."""
    # A ramp covers half of what its time at full speed would: T = length / speed + ramp.
    return max(length_m / speed_mps + ramp_s, 2.0 * ramp_s)


def _approach_mps(section: TargetSection) -> float:
    """Return the largest speed to the first point, m/s."""
    usual_mps = DESCENT_MPS if section.land and len(section.points_m) == 1 else SPEED_MPS
    return usual_mps if section.speed_mps is None else section.speed_mps


def _way_mps(section: TargetSection) -> float:
    """Return the largest speed through the further points, m/s."""
    usual_mps = DESCENT_MPS if section.land else SPEED_MPS
    return usual_mps if section.speed_mps is None else section.speed_mps


def least_approach_s(setup: PlannedRun, section: TargetSection, window: Window) -> float:
    """Return the duration of the approach with the shortest ramps that are tried, s."""
    distance_m = _approach_m(setup, np.array(section.points_m[0]), window)
    return _ramped_s(distance_m, _approach_mps(section), _SHORTEST_RAMP_S)


def least_way_s(section: TargetSection) -> float:
    """Return the least duration of the way through further points, s.

    A spline is no shorter than the distances between its points.
    """
    if section.times_s is not None:
        return section.times_s[-1] - section.times_s[0]
    if len(section.points_m) == 1:
        return 0.0

    steps_I = np.diff(np.array(section.points_m), axis=0)
    length_m = float(np.linalg.norm(steps_I, axis=1).sum())
    return _ramped_s(length_m, _way_mps(section), _WAY_RAMP_S)


def _approach_m(setup: PlannedRun, point_I: Array, window: Window) -> float:
    """Return the larger distance of a target from the path now and from its end, m."""
    # r + s (p - r), (75), adds the speed s' |p - r|. On a straight rest of the path |p - r| is largest
    # at one of its ends. On a curve the larger of both is an estimate: the limits are checked along
    # the approach itself.
    now_and_end_s = np.array([window.since_s, setup.maneuver.duration_s])
    r_I = setup.maneuver.path(now_and_end_s)[0]
    return max(float(np.linalg.norm(point_I - one_I)) for one_I in r_I)


def fastest_approach(setup: PlannedRun, section: TargetSection, window: Window) -> Curve:
    """Return the approach of a target: the fastest of those tried that keeps the limits."""
    point_I = np.array(section.points_m[0])
    distance_m = _approach_m(setup, point_I, window)
    teams = teams_flying(setup, window)

    ramp_s = _SHORTEST_RAMP_S
    problem: str | None = None
    while ramp_s <= _LONGEST_RAMP_S:
        approach = straight(_ramped_s(distance_m, _approach_mps(section), ramp_s), ramp_s)
        # The first one has been checked in `target_fields`; each later one is longer.
        if problem is not None:
            window.check(approach.duration_s)

        path = _approach_path(setup, approach, point_I, window)
        problem = first_exceeded(path, teams, setup)
        if problem is None:
            return approach
        ramp_s *= _LONGER
    raise RequestError(f"points_m: {problem}")


def _approach_path(setup: PlannedRun, approach: Curve, point_I: Array, window: Window) -> Array:
    """Return the jets of the path during an approach, (7, k, 3), or (7, k, 5) with a formation."""
    instants_s = curve_instants(approach)
    if setup.scenario.maneuver.reference == "hover":
        # A hover reference carries no accelerations: the target's motion is judged as from rest, here.
        here_I = setup.maneuver.path(np.array([window.since_s]))[0][0]
        return np.asarray(approach.covered(instants_s, ORDERS)[..., None] * (point_I - here_I))

    target = PathTarget(since_s=window.since_s, point_I=point_I, approach=approach)
    led = setup.maneuver.with_target(target)
    return led.jets(between(maneuver_instants(led), window.since_s, approach.duration_s))


def fastest_way(setup: PlannedRun, section: TargetSection, window: Window) -> Curve:
    """Return the curve through further way points, as fast as given, or as feasible."""
    way = _way_as_given(section)
    path = way.path(curve_instants(way))
    teams = teams_flying(setup, window)
    problem = first_exceeded(path, teams, setup)
    if problem is None:
        return way

    factors = [least_slowing(path, team, setup.settings) for team in teams]
    if None in factors:
        raise RequestError(f"points_m: {problem}")
    factor = max(factor for factor in factors if factor is not None)
    if section.times_s is not None:
        raise RequestError(f"times_s: {problem}; feasible in {factor:.3f} times the time")
    if section.speed_mps is not None:
        raise RequestError(f"speed_mps: {problem}; feasible in {factor:.3f} times the time")
    return replace(way, duration_s=factor * way.duration_s, ramp_s=factor * way.ramp_s)


def teams_flying(setup: PlannedRun, window: Window) -> list[RemainingTeam]:
    """Return the team that flies when a target is given, and those after later releases.

    Whether a release falls within the motion depends on its duration, which is still sought, so the
    limits of each remaining team count for all of the motion.

    Raises: RequestError: the remaining UAVs cannot hover.
    """
    try:
        teams = list(remaining_teams(setup.system, setup.hover, setup.faults))
    except ParameterError as error:
        raise RequestError(str(error)) from error
    tick = round(window.since_s / setup.settings.sampling_period_s)
    first = max(number for number, team in enumerate(teams) if team.tick <= tick)
    return teams[first:]


def first_exceeded(path: Array, teams: list[RemainingTeam], setup: PlannedRun) -> str | None:
    """Return the first limit that one of the teams exceeds along a path, in words."""
    problems = (exceeded(path, team, setup.settings) for team in teams)
    return next((problem for problem in problems if problem is not None), None)


def _way_as_given(section: TargetSection) -> Curve:
    """Return the curve through the way points after the first, not slowed."""
    points_I = np.array(section.points_m)
    further_I = points_I[1:] - points_I[0]
    try:
        if section.times_s is not None:
            times_s = [time_s - section.times_s[0] for time_s in section.times_s[1:]]
            ramp_s = min(_WAY_RAMP_S, times_s[-1] / 2.0)
            way = spline(further_I, times_s[-1], ramp_s, times_s)
            check_way_points(way)
            return way

        return way_through(further_I, _way_mps(section))
    except WayPointError as error:
        raise RequestError(str(error)) from error


def between(instants_s: Array, since_s: float, duration_s: float) -> Array:
    """Return the instants within a duration from a time on, with its ends, s, rising."""
    until_s = since_s + duration_s
    inside = (instants_s > since_s) & (instants_s < until_s)
    return np.array([since_s, *instants_s[inside], until_s])
