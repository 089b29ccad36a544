"""Targets because of obstacles that an agent sees: where it rests, and when it goes round them (78), (78a)."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import runs
from tests.transport.flights.test_obstacles_seen import GO, LOAD_MARGIN_M, MARGIN_M, wall
from transport.agent.planning.sight import Sight, _even, _ways_round
from transport.model.arrays import Array
from transport.model.path.target_and_stop import PathTarget
from transport.model.physics.obstacles import clearances
from transport.model.physics.rotations import rotation
from transport.model.state import StateView
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.targets.target_timing import straight
from transport.protocol.wire.message_form import ENDLESS_M
from transport.protocol.wire.messages import MAX_POINTS, Measurement, Target

ALONG_M = 6.5  # place of the wall
REST_M = 0.3
GENTLE_MPS2, HARD_MPS2, STOP_S = 0.25, 1.5, 1.0
HALVINGS = 2**8


def row(number: int = 1, along_m: float = ALONG_M, **changes: float) -> list[float]:
    """Return a wall of 2 m square to the path as a row of `Measurement.seen`."""
    box = {
        "x": 0.8 * along_m,
        "y": 0.6 * along_m,
        "z": -10.0,
        "heading": math.atan2(7.2, 9.6),
        "half_x": 0.1,
        "half_y": 1.0,
        "half_z": 4.0,
        "radius": 0.0,
        "margin": MARGIN_M,
        "load_margin": LOAD_MARGIN_M,
    }
    return [float(number), *{**box, **changes}.values()]


def flight(speed_mps: float = 1.5) -> Setup:
    """Return a straight flight through the wall."""
    go = GO.replace("speed_mps=1.5", f"speed_mps={speed_mps}")
    return runs.ready("precise", go % 16, wall(ALONG_M, 2.0))


def seen(run: Setup, *rows: Sequence[float]) -> Measurement:
    """Return a measurement in which solids are seen."""
    return replace(runs.measurement(run, 1, 3), seen=np.array(rows))


def rest(run: Setup, now_s: float, load_margin_m: float = LOAD_MARGIN_M) -> Target:
    """Return the target of an agent that sees the wall at a time, without time for a way round it."""
    sight = Sight(1)
    assert sight.take(seen(run, row(load_margin=load_margin_m)))
    avoidance = sight.avoid(run.run, now_s, left_s=0.0)
    assert avoidance is not None
    assert avoidance.text == "sees obstacle 1, no way round it in time: stops before it"
    target = avoidance.target
    assert (target.brakes, target.way_s, target.to) == (True, 0.0, (1,))
    assert target.tick == round(now_s / run.settings.sampling_period_s)
    assert target.approach_ramp_s == target.approach_s / 2.0
    # It is on the path: half of the time of braking further.
    place_I, _ = run.maneuver.path(np.array([now_s + target.approach_s / 2.0]))
    np.testing.assert_allclose(target.points, place_I, atol=1e-9)
    return target


def beyond_margins(
    run: Setup, now_s: float, target: Target, load_margin_m: float = LOAD_MARGIN_M
) -> float:
    """Return by how much the distances of all bodies at a rest exceed their margins, m."""
    x = run.reference.states(np.array([now_s + target.approach_s / 2.0]))
    (apart,) = clearances(run.system, run.obstacles[0], x)
    N = run.system.N
    return float(min(apart[:N].min() - MARGIN_M, apart[N:].min() - load_margin_m))


@pytest.mark.parametrize(
    ("now_s", "more_m", "load_margin_m"),
    [
        (2.5, REST_M, LOAD_MARGIN_M),
        (4.5, REST_M, LOAD_MARGIN_M),
        (4.7, 0.0, LOAD_MARGIN_M),
        (2.5, REST_M, 1.6),  # payload and rods keep the larger one
    ],
)
def test_it_rests_at_the_last_place_that_keeps_its_distance(
    now_s: float, more_m: float, load_margin_m: float
) -> None:
    """Whenever the wall is seen, and at the margins alone where that distance takes a hard braking."""
    run = flight()
    target = rest(run, now_s, load_margin_m)
    speed_mps = 1.5
    resolution_m = speed_mps * (speed_mps / GENTLE_MPS2) / 2.0 / HALVINGS
    assert more_m <= beyond_margins(run, now_s, target, load_margin_m) <= more_m + resolution_m


def test_an_obstacle_is_that_of_the_message() -> None:
    """Its solids and margins by its number in the scenario, by which it is named, whichever is seen first."""
    run = flight()
    sight = Sight(1)
    assert sight.take(seen(run, row(4, radius=0.3, margin=0.5, load_margin=0.7)))
    assert sight.take(seen(run, row(2, along_m=30.0)))
    beside, ahead = sight.seen
    assert (beside.name, ahead.name) == ("obstacle 2", "obstacle 4")
    assert (ahead.margin_m, ahead.load_margin_m) == (0.5, 0.7)
    (solid,) = ahead.solids
    assert (solid.radius, solid.heading_rad) == (0.3, math.atan2(7.2, 9.6))
    np.testing.assert_array_equal(solid.centre_I, [0.8 * ALONG_M, 0.6 * ALONG_M, -10.0])
    np.testing.assert_array_equal(solid.half, [0.1, 1.0, 4.0])
    avoidance = sight.avoid(run.run, 2.11, left_s=0.0)
    assert avoidance is not None
    assert avoidance.text.startswith("sees obstacle 4, ")
    # It begins at the next tick, on the path.
    target = avoidance.target
    assert target.tick == 43
    place_I, _ = run.maneuver.path(np.array([0.05 * 43 + target.approach_s / 2.0]))
    np.testing.assert_allclose(target.points, place_I, atol=1e-9)


@pytest.mark.parametrize("speed_mps", [1.2, 2.4])
def test_decelerations_are_within_their_range(speed_mps: float) -> None:
    """Far away the mean one is the least, 0.25 m/s^2; too near, 1.5 m/s^2, in no less than a second."""
    run = flight(speed_mps)
    times_s = run.reference.times_s
    places_I, v_I = run.maneuver.path(times_s)
    along_m = np.linalg.norm((places_I - places_I[0])[:, :2], axis=1)
    far_s, near_s = (float(times_s[np.argmax(along_m > metres)]) for metres in (0.02, 5.5))
    slow_mps = float(np.linalg.norm(v_I[np.argmax(along_m > 0.02)]))
    assert rest(run, far_s).approach_s == pytest.approx(max(slow_mps / GENTLE_MPS2, 2.0 * STOP_S))
    assert rest(run, near_s).approach_s == pytest.approx(max(speed_mps / HARD_MPS2, STOP_S))


def test_two_ways_round_the_same_obstacles_are_tried() -> None:
    """Then it stops before them, until another one is seen; a way that takes longer than is left is none."""
    run = flight()
    sight = Sight(2)
    assert not sight.take(runs.measurement(run, 1, 3))
    assert sight.take(seen(run, row(1), row(1, half_x=0.2)))
    assert not sight.take(seen(run, row(1)))

    def avoided(left_s: float) -> tuple[Target, str]:
        """Return the target at 2.5 s, and what it does."""
        found = sight.avoid(run.run, 2.5, left_s=left_s)
        assert found is not None
        return found.target, found.text.rpartition(": ")[2]

    way, text = avoided(24.0)
    takes_s = way.approach_s + way.way_s
    # The limits make it slower, as a whole: its ramps of 2 s take longer, over the same length.
    speed_mps = cruise_mps(run, way)
    assert speed_mps < 0.95 * 1.5
    assert way.way_ramp_s * speed_mps == pytest.approx(2.0 * 1.5, rel=0.02)
    texts = [text, *(avoided(left_s)[1] for left_s in (takes_s - 0.01, 24.0))]
    assert sight.take(seen(run, row(3, along_m=30.0, half_z=ENDLESS_M)))
    texts.append(avoided(takes_s + 0.01)[1])
    goes_round, stops = "goes round it", "stops before it"
    assert texts == [goes_round, stops, stops, goes_round]
    assert [[len(one.solids) for one in sight.seen], sight.seen[1].solids[0].half[2]] == [
        [2, 1],
        np.inf,
    ]
    np.testing.assert_allclose(way.points[-1], [9.6, 7.2, -10.0], atol=1e-6)
    led = run.after([way])
    at_s = 2.5 + way.approach_s + np.linspace(0.0, way.way_s, 40)
    apart = clearances(run.system, run.obstacles[0], led.reference.states(at_s))
    assert apart[:, : run.system.N].min() > MARGIN_M + 0.19


def test_a_path_that_keeps_clear_stays() -> None:
    """No target because of an obstacle beside the path, or behind."""
    run = flight()
    for along_m, now_s in [(20.0, 2.5), (ALONG_M, 8.0)]:
        sight = Sight(1)
        assert sight.take(seen(run, row(along_m=along_m)))
        assert sight.avoid(run.run, now_s, left_s=0.0) is None


def ways(
    *rows: Sequence[float], most_m: float = 100.0, slant: float = 0.0, turned: float = 0.0
) -> list[Array]:
    """Return the points of ways round what is seen, from a rest 3 m before the wall of a climb to its end.

    Rods may slant outwards, their sine, and attachments may be turned, rad, on their circle of 0.25 sqrt(2) m.
    """
    climb = (GO % 16).replace("9.6,7.2,0", "9.6,7.2,-3")
    run = runs.ready("precise", climb, wall(ALONG_M, 2.0))
    sight = Sight(1)
    sight.take(seen(run, *rows))
    x = run.hover.x.copy()
    down = math.sqrt(1.0 - slant**2)
    for uav, e in zip(run.system.uavs, StateView(x).e_P, strict=True):
        e[:] = [*(-slant / math.sqrt(2.0) * np.sign(uav.rho[:2])), down]
    R = np.asarray(rotation(np.array([0.0, 0.0, turned])))
    uavs = tuple(dataclasses.replace(uav, rho=R @ uav.rho) for uav in run.system.uavs)
    system = dataclasses.replace(run.system, uavs=uavs)
    team = dataclasses.replace(
        run.run.team, system=system, hover=dataclasses.replace(run.hover, x=x)
    )
    rest_I = run.maneuver.path(np.array([4.0]))[0][0]
    brake = PathTarget(since_s=2.0, point_I=rest_I, approach=straight(4.0, 2.0), brakes=True)
    found = [*_ways_round(dataclasses.replace(run.run, team=team), sight.seen, brake, most_m)]
    for way in found:
        np.testing.assert_allclose(way[0], rest_I)
        np.testing.assert_allclose(way[-1], [9.6, 7.2, -13.0], atol=1e-5)
    return found


def length_m(way: Array) -> float:
    """Return the length of a way through its points."""
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())


@pytest.mark.parametrize(
    ("margin_m", "load_margin_m", "slant", "turned", "keeps_m"),
    [
        (0.4, 0.1, 0.0, 0.0, math.hypot(0.25, 0.25) + 0.4),
        (0.2, 1.0, 0.0, 0.0, math.hypot(0.25, 0.25) + 1.0),
        (0.4, 0.1, 0.1, 0.0, math.hypot(0.25, 0.25) + 0.1 * 3.2 + 0.4),  # rods of 3.2 m
        (0.2, 1.0, 0.1, 0.0, math.hypot(0.25, 0.25) + 0.1 * 3.2 + 1.0),
        (
            0.2,
            1.0,
            0.0,
            math.pi / 4.0,
            math.hypot(0.25, 0.25) * math.sqrt(2.0) + 1.0,
        ),  # the box about them
    ],
)
def test_ways_round_keep_the_reach_of_the_team(
    margin_m: float, load_margin_m: float, slant: float, turned: float, keeps_m: float
) -> None:
    """The farthest of UAVs, rods and payload is a margin and 0.6, 1 or 1.8 m from the wall, in this order.

    They climb evenly, in legs of a metre, and none is longer than what is left.
    """
    wall_seen = row(margin=margin_m, load_margin=load_margin_m)
    found = ways(wall_seen, slant=slant, turned=turned)
    u = np.array([0.8, 0.6])
    for way, more_m in zip(found, (0.6, 1.0, 1.8), strict=True):
        xy = way[:, :2] - ALONG_M * u
        beyond = np.abs(np.column_stack([xy @ u, xy @ [-0.6, 0.8]])) - [0.1, 1.0]
        apart_m = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        least_m = keeps_m + more_m
        # The sides of an outline touch the circle of that radius, its corners are 4 % further.
        assert least_m - 1e-6 <= apart_m[3:-3].min() <= 1.04 * least_m
        legs_m = np.linalg.norm(np.diff(way, axis=0), axis=1)
        assert 0.6 < legs_m.min() <= legs_m.max() <= 1.0
        climbs = -np.diff(way[:, 2])
        assert climbs.min() > 0.03
        assert climbs.max() < 0.3
    short, long = length_m(found[1]), length_m(found[2])
    assert len(ways(wall_seen, most_m=(short + long) / 2.0, slant=slant, turned=turned)) == 2


@pytest.mark.parametrize(("along_m", "count"), [(10.9, 0), (10.4, 1)])
def test_no_way_leads_to_an_end_that_is_too_near(along_m: float, count: int) -> None:
    """The path ends 12 m along, 1.05 or 1.55 m behind what is seen there, whose reach is 0.75 m."""
    assert len(ways(row(), row(2, along_m, half_x=0.05, half_y=0.05))) == count


@pytest.mark.parametrize(("metres", "points"), [(0.5, 3), (7.2, 9), (1000.0, MAX_POINTS)])
def test_a_way_has_as_many_points_as_a_target_may(metres: float, points: int) -> None:
    """One a metre, no fewer than three, at equal lengths."""
    way = _even(np.array([[0.0, 0.0, 0.0], [0.1 * metres, 0.0, 0.0], [metres, 0.0, 0.0]]))
    np.testing.assert_allclose(way[:, 0], np.linspace(0.0, metres, points))


def cruise_mps(run: Setup, way: Target) -> float:
    """Return the speed in the middle of a way from 2.5 s on."""
    middle_s = 2.5 + way.approach_s + way.way_s * np.linspace(0.3, 0.7, 20)
    v_I = run.run.led_to(way).maneuver.path(middle_s)[1]
    return float(np.linalg.norm(v_I, axis=1).max())


def test_a_way_round_is_as_fast_as_the_path() -> None:
    """Where the limits let it be."""
    run = flight(0.8)
    sight = Sight(1)
    sight.take(seen(run, row()))
    found = sight.avoid(run.run, 2.5, left_s=60.0)
    assert found is not None
    assert cruise_mps(run, found.target) == pytest.approx(0.8, rel=0.02)


def test_a_way_that_is_too_near_or_too_fast_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its curve keeps 0.2 m more than the margins, and some time along it the limits: else the team stops."""
    run = flight(0.8)

    def does() -> str:
        sight = Sight(1)
        sight.take(seen(run, row()))
        found = sight.avoid(run.run, 2.5, left_s=60.0)
        return "" if found is None else found.text.rpartition(": ")[2]

    place = Sight.__module__
    monkeypatch.setattr(f"{place}._ROUND_M", (0.1,))
    assert does() == "stops before it"
    monkeypatch.setattr(f"{place}._ROUND_M", (0.6,))
    monkeypatch.setattr(f"{place}.exceeded", lambda *_: "too fast")
    assert does() == "stops before it"
