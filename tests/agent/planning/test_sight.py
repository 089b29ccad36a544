"""Targets because of obstacles that an agent sees: where it rests, and when it goes round them (78), (78a)."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import runs
from tests.transport.flights.test_obstacles_seen import GO, LOAD_MARGIN_M, MARGIN_M, wall
from transport.agent.planning.sight import Sight
from transport.model.physics.obstacles import clearances
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.message_form import ENDLESS_M
from transport.protocol.wire.messages import Measurement, Target

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
    avoidance = sight.avoid(run.run, 2.51, left_s=0.0)
    assert avoidance is not None
    assert avoidance.text.startswith("sees obstacle 4, ")
    # It begins at the next tick, on the path.
    target = avoidance.target
    assert target.tick == 51
    place_I, _ = run.maneuver.path(np.array([0.05 * 51 + target.approach_s / 2.0]))
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
