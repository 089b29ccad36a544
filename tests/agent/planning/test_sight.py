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


def rest(run: Setup, now_s: float) -> Target:
    """Return the target of an agent that sees the wall at a time, without time for a way round it."""
    sight = Sight(1)
    assert sight.take(seen(run, row()))
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


def beyond_margins(run: Setup, now_s: float, target: Target) -> float:
    """Return by how much the distances of all bodies at a rest exceed their margins, m."""
    x = run.reference.states(np.array([now_s + target.approach_s / 2.0]))
    (apart,) = clearances(run.system, run.obstacles[0], x)
    N = run.system.N
    return float(min(apart[:N].min() - MARGIN_M, apart[N:].min() - LOAD_MARGIN_M))


@pytest.mark.parametrize(
    ("now_s", "more_m"), [(2.5, REST_M), (3.5, REST_M), (4.5, REST_M), (4.7, 0.0)]
)
def test_it_rests_at_the_last_place_that_keeps_its_distance(now_s: float, more_m: float) -> None:
    """Whenever the wall is seen, and at the margins alone where that distance takes a hard braking."""
    run = flight()
    target = rest(run, now_s)
    speed_mps = 1.5
    resolution_m = speed_mps * (speed_mps / GENTLE_MPS2) / 2.0 / HALVINGS
    assert more_m <= beyond_margins(run, now_s, target) <= more_m + resolution_m


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
    """Then it stops before them, until another one is seen."""
    run = flight()
    sight = Sight(2)
    assert not sight.take(runs.measurement(run, 1, 3))
    assert sight.take(seen(run, row(1), row(1, half_x=0.2)))
    assert not sight.take(seen(run, row(1)))
    found = [sight.avoid(run.run, 2.5, left_s=24.0) for _ in range(3)]
    assert sight.take(seen(run, row(3, along_m=30.0, half_z=ENDLESS_M)))
    found.append(sight.avoid(run.run, 2.5, left_s=24.0))
    texts = [one.text for one in found if one is not None]
    goes_round, stops = "goes round it", "stops before it"
    assert [text.rpartition(": ")[2] for text in texts] == [
        goes_round,
        goes_round,
        stops,
        goes_round,
    ]
    assert [[len(one.solids) for one in sight.seen], sight.seen[1].solids[0].half[2]] == [
        [2, 1],
        np.inf,
    ]
    round_it = found[0]
    assert round_it is not None
    np.testing.assert_allclose(round_it.target.points[-1], [9.6, 7.2, -10.0], atol=1e-6)
    assert round_it.target.way_s <= 24.0 - round_it.target.approach_s


def test_a_path_that_keeps_clear_stays() -> None:
    """No target because of an obstacle beside the path, or behind."""
    run = flight()
    for along_m, now_s in [(20.0, 2.5), (ALONG_M, 8.0)]:
        sight = Sight(1)
        assert sight.take(seen(run, row(along_m=along_m)))
        assert sight.avoid(run.run, now_s, left_s=0.0) is None
