"""Obstacles that an agent has seen, and the targets that it hands to the team because of them.

Where what is left of its path comes too near to an obstacle that it has seen, the agent makes a target: the
payload comes to a rest along its path before the obstacle, goes round it where there is a way, and on along
the path from behind it. Source: docs/equations.md (78), (78a), (78b).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.path.curves import Curve
from transport.model.path.flatness import slowed
from transport.model.path.target_and_stop import STOP_S, PathTarget
from transport.model.path.way_round import outline, shortest_way, within
from transport.model.physics.obstacles import Obstacle, Solid
from transport.model.physics.parameters import payload_half_size
from transport.protocol.admission.targets_in_plans import number_of_sight
from transport.protocol.scenario.checks.feasibility import RemainingTeam, exceeded
from transport.protocol.scenario.checks.obstacle_margins import first_blocked
from transport.protocol.scenario.sections.path_instants import (
    WayPointError,
    curve_instants,
    maneuver_instants,
)
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.scenario.targets.target_timing import straight, way_through
from transport.protocol.wire.message_form import ENDLESS_M
from transport.protocol.wire.messages import MAX_POINTS, Measurement, Target
from transport.protocol.wire.names import agent_name

# Distances beyond the margins that a way keeps: of the rest before an obstacle, and of the outline that
# the shortest way round follows, the next one where the curve through its corners comes too near, m.
_REST_M = 0.3
_ROUND_M = (0.6, 1.0, 1.8)
_CURVE_M = 0.2
# Means of the deceleration, m/s^2: the least one, and the largest where the obstacle is that near.
_GENTLE_MPS2, _HARD_MPS2 = 0.25, 1.5
_SEARCHES = 8  # halvings of the time along the path to its last place before an obstacle
# Factors on the time of a way, of which the first one with which it keeps the limits: a few trials, as the
# agent that sees has no time for many.
_SLOWER = (1.0, 1.15, 1.3, 1.5, 2.0, 3.0)
_LEG_M = 1.0  # between points of a way
_SLOWEST_MPS = 0.3
_WAYS = 2  # round the same obstacles: two that see different ones do not plan against each other for ever


@dataclass(frozen=True, slots=True, kw_only=True)
class Avoidance:
    """A target because of an obstacle, and the reason in words."""

    target: Target
    text: str


class Sight:
    """What one agent, 1-based, has seen."""

    def __init__(self, agent: int) -> None:
        self._agent = agent
        self._seen: dict[int, Obstacle] = {}  # by number in the scenario
        self._ways = 0  # since the newest one was seen

    @property
    def seen(self) -> tuple[Obstacle, ...]:
        """Obstacles that this agent has seen, in the order of the scenario."""
        return tuple(self._seen[number] for number in sorted(self._seen))

    def take(self, measurement: Measurement) -> bool:
        """Keep what the own UAVs see; return whether an obstacle is a new one."""
        if not len(measurement.seen):
            return False
        numbers = {int(number) for number in measurement.seen[:, 0]} - self._seen.keys()
        for number in numbers:
            rows = measurement.seen[measurement.seen[:, 0] == number]
            self._seen[number] = _obstacle(number, rows)
            self._ways = 0
        return bool(numbers)

    def avoid(self, run: TeamRun, now_s: float, left_s: float) -> Avoidance | None:
        """Return a target that keeps clear of what has been seen; None if the path does already.

        Args:
            run: The run as this agent follows it, without losses of time.
            now_s: Time along its path, s.
            left_s: Time until the run ends, s.
        """
        numbers = sorted(self._seen)
        obstacles = [self._seen[number] for number in numbers]
        blocked = _blocked(run, obstacles, now_s, run.reference.times_s[-1])
        if blocked is None:
            return None
        number = numbers[blocked[0] - 1]

        brake = _braking(run, obstacles, now_s)
        way = None
        if self._ways < _WAYS:
            self._ways += 1
            way = _way(run, obstacles, brake, left_s)
        target = self._target(run, replace(brake, way=way))
        if way is None:
            text = f"sees obstacle {number}, no way round it in time: stops before it"
        else:
            text = f"sees obstacle {number}: goes round it"
        return Avoidance(target=target, text=text)

    def _target(self, run: TeamRun, path: PathTarget) -> Target:
        """Return the message of a target."""
        period_s = run.settings.sampling_period_s
        points = path.point_I[None]
        way_s = way_ramp_s = 0.0
        if path.way is not None:
            points = np.vstack([points, path.point_I + np.asarray(path.way.points_I)])
            way_s, way_ramp_s = path.way.duration_s, path.way.ramp_s
        times = np.zeros(len(points))
        for array in (points, times):
            array.setflags(write=False)
        return Target(
            sender=agent_name(self._agent),
            incarnation=0,
            sequence=0,
            tick=round(path.since_s / period_s),
            number=number_of_sight(self._agent),
            points=points,
            times=times,
            approach_s=path.approach.duration_s,
            approach_ramp_s=path.approach.ramp_s,
            way_s=way_s,
            way_ramp_s=way_ramp_s,
            to=(self._agent,),
            brakes=True,
        )


def _obstacle(number: int, rows: Array) -> Obstacle:
    """Return the obstacle in rows of `Measurement.seen`."""
    solids = []
    for row in rows:
        half = np.where(row[5:8] < ENDLESS_M, row[5:8], np.inf)
        solids.append(Solid(centre_I=row[1:4], heading_rad=row[4], half=half, radius=row[8]))
    return Obstacle(
        name=f"obstacle {number}",
        solids=tuple(solids),
        margin_m=rows[0, 9],
        load_margin_m=rows[0, 10],
        penalty=0.0,  # it is in no program
    )


def _blocked(
    run: TeamRun, obstacles: Sequence[Obstacle], since_s: float, until_s: float, more_m: float = 0.0
) -> tuple[int, str] | None:
    """Return the first obstacle whose margins, and some more, the path violates in a time, s."""
    instants_s = maneuver_instants(run.maneuver)
    inside = (instants_s > since_s) & (instants_s < until_s)
    times_s = np.array([since_s, *instants_s[inside], until_s])
    wider = [
        replace(one, margin_m=one.margin_m + more_m, load_margin_m=one.load_margin_m + more_m)
        for one in obstacles
    ]
    return first_blocked(run.system, wider, run.reference.states, times_s)


def _braking(run: TeamRun, obstacles: Sequence[Obstacle], now_s: float) -> PathTarget:
    """Return the target at which the payload comes to a rest along its path before the obstacles.

    At its last place that keeps the distance of a rest, or else the margins: the same one for all agents, whenever
    they see an obstacle. A rest before it where that takes less than the least deceleration.
    """
    period_s = run.settings.sampling_period_s
    since_s = period_s * math.ceil(now_s / period_s - 1e-6)
    _, v_I = run.maneuver.path(np.array([since_s]))
    speed_mps = float(np.linalg.norm(v_I))
    # Half of the time of braking is the time along the path.
    longest_s = max(speed_mps / _GENTLE_MPS2, 2.0 * STOP_S) / 2.0
    least_s = max(speed_mps / _HARD_MPS2, STOP_S) / 2.0

    def free_s(more_m: float) -> float:
        """Return the time along the path, up to the longest, in which it keeps the margins and more."""
        if _blocked(run, obstacles, since_s, since_s + longest_s, more_m) is None:
            return longest_s
        low_s, high_s = 0.0, longest_s
        for _ in range(_SEARCHES):
            middle_s = (low_s + high_s) / 2.0
            is_free = _blocked(run, obstacles, since_s, since_s + middle_s, more_m) is None
            low_s, high_s = (middle_s, high_s) if is_free else (low_s, middle_s)
        return low_s

    along_s = free_s(_REST_M)
    if along_s < least_s:
        along_s = max(free_s(0.0), least_s)
    rest_I = run.maneuver.path(np.array([since_s + along_s]))[0][0]
    approach = straight(2.0 * along_s, along_s)
    return PathTarget(since_s=since_s, point_I=rest_I, approach=approach, brakes=True)


def _way(
    run: TeamRun, obstacles: Sequence[Obstacle], brake: PathTarget, left_s: float
) -> Curve | None:
    """Return the curve round the obstacles from a rest, as fast as the path and the limits; None without one."""
    most_s = left_s - brake.approach.duration_s
    times_s = run.reference.times_s
    times_s = times_s[times_s >= brake.since_s]
    speed_mps = max(
        float(np.linalg.norm(run.maneuver.path(times_s)[1], axis=1).max()), _SLOWEST_MPS
    )

    team = RemainingTeam(tick=0, system=run.system, hover=run.hover, released=frozenset())
    for points_I in _ways_round(run, obstacles, brake, speed_mps * most_s):
        try:
            way = way_through(points_I[1:] - points_I[0], speed_mps)
        except WayPointError:
            continue
        path = way.path(curve_instants(way))
        factors = (
            one for one in _SLOWER if exceeded(slowed(path, one), team, run.settings) is None
        )
        factor = next(factors, None)
        if factor is None:
            continue
        way = replace(way, duration_s=factor * way.duration_s, ramp_s=factor * way.ramp_s)
        if way.duration_s > most_s:
            continue
        target = replace(brake, way=way)
        led = run.with_target(target)
        if _blocked(led, obstacles, brake.reached_s, target.ends_s, _CURVE_M) is None:
            return way
    return None


def _ways_round(
    run: TeamRun, obstacles: Sequence[Obstacle], brake: PathTarget, most_m: float
) -> Iterator[Array]:
    """Yield points of ways from a rest to the end of the path, (k, 3), m, none longer than a length.

    Round the outlines of the obstacles at the first place of the path behind them, and then along the path.
    """
    path_I = _path_left(run, brake)
    for more_m in _ROUND_M:
        polygons = []
        for obstacle in obstacles:
            radius_m = _reach(run, obstacle) + more_m
            polygons += [outline(solid, radius_m) for solid in obstacle.solids]

        is_in = np.any([within(path_I[:, :2], polygon) for polygon in polygons], axis=0)
        if is_in[-1]:
            continue
        behind = int(np.flatnonzero(is_in)[-1]) + 1 if is_in.any() else len(path_I) - 1
        round_xy = shortest_way(brake.point_I[:2], path_I[behind, :2], polygons)
        if round_xy is None:
            continue
        legs_m = np.linalg.norm(np.diff(round_xy, axis=0), axis=1)
        rest_m = np.linalg.norm(np.diff(path_I[behind:], axis=0), axis=1).sum()
        if legs_m.sum() + rest_m > most_m:
            continue

        # Heights change evenly along the way round.
        share = np.concatenate([[0.0], np.cumsum(legs_m)]) / max(legs_m.sum(), 1e-9)
        heights = brake.point_I[2] + share * (path_I[behind, 2] - brake.point_I[2])
        round_I = np.column_stack([round_xy, heights])
        yield _even(np.vstack([round_I, path_I[behind + 1 :]]))


def _path_left(run: TeamRun, brake: PathTarget) -> Array:
    """Return the places of the path from a rest on, without those at which it stays, (k, 3), m."""
    times_s = run.reference.times_s
    times_s = np.array([brake.rest_s, *times_s[times_s > brake.rest_s]])
    path_I, _ = run.maneuver.path(times_s)
    moves = np.linalg.norm(np.diff(path_I, axis=0), axis=1) > 1e-6
    return np.asarray(path_I[np.append(True, moves)])


def _reach(run: TeamRun, obstacle: Obstacle) -> float:
    """Return how near the payload's place may come to an obstacle from above, with all bodies at hover, m."""
    e = state.StateView(run.hover.x).e_P
    reach_m = [float(np.linalg.norm(payload_half_size(run.system)[:2])) + obstacle.load_margin_m]
    for uav, rod in zip(run.system.uavs, e, strict=True):
        attached = float(np.linalg.norm(uav.rho[:2]))
        centre = float(np.linalg.norm((uav.rho - uav.rod_length * rod)[:2]))
        reach_m += [attached + obstacle.load_margin_m, centre + obstacle.load_margin_m]
        reach_m.append(centre + obstacle.margin_m)
    return float(max(reach_m))


def _even(way: Array) -> Array:
    """Return places at equal lengths along a way, (k, 3), some `_LEG_M` apart or further on a long one.

    A curve through uneven ones swings, and would have to be slow for it.
    """
    lengths_m = np.linalg.norm(np.diff(way, axis=0), axis=1)
    at_m = np.concatenate([[0.0], np.cumsum(lengths_m)])
    pieces = min(max(math.ceil(at_m[-1] / _LEG_M), 2), MAX_POINTS - 1)
    wanted_m = np.linspace(0.0, at_m[-1], pieces + 1)
    return np.column_stack([np.interp(wanted_m, at_m, way[:, axis]) for axis in range(3)])
