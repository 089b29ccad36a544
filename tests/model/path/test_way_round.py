"""Ways round solids in the plane: docs/equations.md (78b)."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from transport.model.arrays import Array
from transport.model.path.way_round import outline, shortest_way, within
from transport.model.physics.obstacles import Solid

BELOW_1_M = st.floats(0.1, 1.0)
START, GOAL = np.array([-8.0, 0.0]), np.array([8.0, 0.0])
DENSE = 400  # points of a way that are compared with solids
# A polygon of 12 sides about a disc reaches this much further.
POLYGON = 1.0 / math.cos(math.pi / 12.0)


def solid(x: float, y: float, half: tuple[float, float], heading_rad: float = 0.0) -> Solid:
    """Return an upright box without ends."""
    return Solid(
        centre_I=np.array([x, y, -10.0]), heading_rad=heading_rad, half=np.array([*half, np.inf])
    )


def dense(way: Array) -> Array:
    """Return points along a way, (k, 2)."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    at = np.linspace(0.0, lengths[-1], DENSE)
    return np.column_stack([np.interp(at, lengths, way[:, axis]) for axis in range(2)])


def length(way: Array) -> float:
    """Return the length of a way, m."""
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())


def test_past_a_wall_the_way_bends_at_its_nearer_corner() -> None:
    """A wall that reaches 1 m further to one side: the way is that round the other, to the polygon's excess."""
    wall = solid(0.0, 1.0, (0.0, 2.0))
    way = shortest_way(START, GOAL, [outline(wall, 0.5)])
    assert way is not None
    assert way[:, 1].min() == pytest.approx(-1.5, abs=0.5 * (POLYGON - 1.0) + 1e-6)
    tangents = 2.0 * math.hypot(8.0, 1.0)  # to the corner itself: the least with any distance
    assert tangents < length(way) < 2.0 * math.hypot(8.0, 1.0 + 0.5 * POLYGON)


def test_a_gap_is_passed_where_it_is_wide_enough() -> None:
    """Between two walls without other ends: straight where twice the distance fits, else far round."""
    walls = [solid(0.0, side * (1e4 + 0.5), (0.1, 1e4)) for side in (-1.0, 1.0)]
    through = shortest_way(START, GOAL, [outline(wall, 0.45) for wall in walls])
    assert through is not None
    assert length(through) == pytest.approx(16.0)
    around = shortest_way(START, GOAL, [outline(wall, 0.55) for wall in walls])
    assert around is None or length(around) > 1e4


def test_without_a_way_there_is_none() -> None:
    """A goal within the distance of a solid, and a start shut in by four walls."""
    assert shortest_way(START, GOAL, [outline(solid(8.0, 0.0, (0.1, 0.1)), 0.5)]) is None
    sides = [(-9.0, 0.0, (0.1, 2.0)), (-7.0, 0.0, (0.1, 2.0))]
    ends = [(-8.0, -1.5, (2.0, 0.1)), (-8.0, 1.5, (2.0, 0.1))]
    shut_in = [outline(solid(x, y, half), 0.3) for x, y, half in (*sides, *ends)]
    assert shortest_way(START, GOAL, shut_in) is None


@pytest.mark.parametrize("x_m", [(-7.0,), (-7.0, -6.8), (-6.8, -7.0), (-7.2, -7.0, -6.8)])
def test_a_start_too_near_leaves_by_the_nearest_side(x_m: tuple[float, ...]) -> None:
    """The first point is the start, the second one outside of all solids that it was too near to."""
    polygons = [outline(solid(x, 0.0, (0.2, 2.0)), 1.0) for x in x_m]
    way = shortest_way(START, GOAL, polygons)
    assert way is not None
    np.testing.assert_array_equal(way[0], START)
    assert way[1][0] < min(x_m) - 1.1
    for polygon in polygons:
        assert not within(dense(way[1:]), polygon).any()


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(-5.0, 5.0), st.floats(-2.0, 2.0), BELOW_1_M, BELOW_1_M, st.floats(0.0, 3.0)
        ),
        min_size=1,
        max_size=4,
    )
)
def test_a_way_among_random_solids_keeps_the_distance(
    boxes: list[tuple[float, float, float, float, float]],
) -> None:
    """All of it, from each solid itself; it is no shorter than straight, and not by chance far too long."""
    solids = [solid(x, y, (a, b), heading) for x, y, a, b, heading in boxes]
    way = shortest_way(START, GOAL, [outline(one, 0.5) for one in solids])
    assert way is not None  # both ends are free, and four small boxes shut nothing in
    points = np.column_stack([dense(way), np.full(DENSE, -10.0)])
    for one in solids:
        distances, _ = one.from_points(points)
        assert distances.min() > 0.5 - 1e-5
    assert 16.0 - 1e-9 <= length(way) < 32.0
