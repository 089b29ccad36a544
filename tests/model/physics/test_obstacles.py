"""Distances between obstacles and the bodies of a team."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.hover import hover
from transport.model.physics.obstacles import Obstacle, Solid, bodies, clearances
from transport.model.physics.parameters import table_1
from transport.model.physics.rotations import rotation

# Of the least-squares problem.
SAME_M = 1e-7
# Central differences over 1e-5 m of functions whose curvature is below 100 1/m.
SAME_SLOPE = 1e-4


def nearest(
    centre: Array, R: Array, half: Array, other: Array, R_other: Array, other_half: Array
) -> float:
    """Return the distance of two boxes.

    The smallest of c + R a - c' - R' b over |a| <= h, |b| <= h'.
    """
    bounds = np.minimum(np.concatenate([half, other_half]), 1e3) + 1e-12
    best = lsq_linear(np.hstack([R, -R_other]), other - centre, bounds=(-bounds, bounds), tol=1e-15)
    return float(np.sqrt(2.0 * best.cost))


@pytest.mark.parametrize(
    "half", [[0, 0, 0], [0, 0, np.inf], [0.4, 0.1, 0.7], [0.1, np.inf, np.inf]]
)
def test_distances_are_those_of_a_least_squares_problem(half: list[float]) -> None:
    """Distances of points, segments and boxes, apart and overlapping, from sphere, cylinder, box and wall: (69a)."""
    rng = np.random.default_rng(5)
    solid = Solid(
        centre_I=rng.normal(size=3), heading_rad=0.7, half=np.array(half, dtype=float), radius=0.05
    )
    r, size, touching = (
        0.7 * rng.normal(size=(60, 3)) + solid.centre_I,
        np.array([0.5, 0.3, 0.1]),
        0,
    )
    R = np.array([rotation(Theta) for Theta in rng.normal(size=(60, 3))])
    for what in (size, size * [1, 0, 0], 0.0 * size):
        ends = r + R @ (what * [1, 0, 0]), r - R @ (what * [1, 0, 0])
        found = solid.from_boxes(r, R, size) if what[1] else solid.from_segments(*ends)
        for i, distance in enumerate(found):
            expected = nearest(r[i], R[i], what, solid.centre_I, solid.R, solid.half) - solid.radius
            touching += expected <= 0.0
            assert distance == pytest.approx(expected, abs=SAME_M)
    distances, normals = solid.from_points(r)
    outside = distances > 0.0
    np.testing.assert_allclose(distances[outside], found[outside], atol=SAME_M)
    assert touching
    # Within the rounding, beyond an edge or a corner.
    has_end = np.isfinite(solid.half)
    within = solid.centre_I + solid.R @ np.where(has_end, solid.half + 0.02, 0.0)
    distance = float(solid.from_points(within)[0])
    assert distance == pytest.approx(0.02 * np.sqrt(has_end.sum()) - solid.radius, abs=SAME_M)
    for axis in np.eye(3):
        slopes = [solid.from_points(r + sign * 1e-5 * axis)[0] for sign in (1.0, -1.0)]
        np.testing.assert_allclose(normals @ axis, (slopes[0] - slopes[1]) / 2e-5, atol=SAME_SLOPE)


def test_clearances_of_a_team_by_hand() -> None:
    """UAVs, rods and payload of the hovering team beside a wall at y = 1 m and under a ball above the payload."""
    system = table_1()
    x = hover(system).x[None] + np.concatenate([[0.0, 0.0, -10.0], np.zeros(57)])
    wall = Solid(
        centre_I=np.array([0.0, 2.0, 0.0]), heading_rad=0.0, half=np.array([np.inf, 1.0, np.inf])
    )
    ball = Solid(
        centre_I=np.array([0.0, 0.0, -11.0]), heading_rad=0.0, half=np.zeros(3), radius=0.2
    )

    def clear_of(*solids: Solid) -> Array:
        obstacle = Obstacle(name="", solids=solids, margin_m=0.3, load_margin_m=0.1, penalty=1.0)
        found: Array = clearances(system, obstacle, x)[0]
        return found

    np.testing.assert_allclose(clear_of(wall), [0.75, 1.25, 1.25, 0.75] * 2 + [0.75], atol=SAME_M)
    from_ball = (
        [np.hypot(np.hypot(0.25, 0.25), 2.325) - 0.2] * 4
        + [np.hypot(0.25, 0.25) - 0.2] * 4
        + [0.675]
    )
    np.testing.assert_allclose(clear_of(ball), from_ball, atol=SAME_M)
    np.testing.assert_array_equal(clear_of(wall, ball), np.minimum(clear_of(wall), clear_of(ball)))


@pytest.mark.parametrize("axis", [0, 2], ids=["beam", "pole"])
def test_an_endless_solid_is_as_near_everywhere(axis: int) -> None:
    """Kilometres along a beam or a pole through its payload a team that leans has the same distances, (69a)."""
    system = table_1()
    half = np.zeros(3)
    half[axis] = np.inf
    solid = Solid(centre_I=np.array([0.0, 0.0, -10.0]), heading_rad=0.0, half=half, radius=0.05)
    obstacle = Obstacle(name="", solids=(solid,), margin_m=0.3, load_margin_m=0.1, penalty=1.0)
    x = np.tile(hover(system).x, (4, 1))
    x[:, state.THETA0] = (0.2, -0.1, 0.3)
    x[:, :3] = (0.02, 0.01, -10.0)
    x[1:, axis] += (900.0, -9000.0, -30.0)
    here, *elsewhere = clearances(system, obstacle, x)
    assert here[-1] == -0.05
    for found in elsewhere:
        np.testing.assert_allclose(found, here, atol=1e-9)


def test_gradients_are_those_of_the_nearest_of_several_solids() -> None:
    """Distances of points are the least of all solids, gradients their finite differences."""
    rng = np.random.default_rng(7)
    solids = tuple(
        Solid(
            centre_I=np.array(centre),
            heading_rad=0.4,
            half=np.array(half, dtype=float),
            radius=0.05,
        )
        for centre, half in (
            ([-1.0, 0.0, 0.0], [0.3, 0.2, 0.4]),
            ([1.0, 0.5, 0.0], [0.0, 0.0, np.inf]),
            ([0.0, -1.0, 1.0], [0.0, 0.0, 0.0]),
        )
    )
    obstacle = Obstacle(name="", solids=solids, margin_m=0.3, load_margin_m=0.1, penalty=1.0)
    r = rng.normal(size=(60, 3))
    each = np.array([solid.from_points(r)[0] for solid in solids])
    distances, gradients = obstacle.from_points(r)
    np.testing.assert_array_equal(distances, each.min(axis=0))
    assert set(each.argmin(axis=0)) == {0, 1, 2}, "a solid is nowhere the nearest"
    for axis in np.eye(3):
        ahead, behind = (obstacle.from_points(r + sign * 1e-5 * axis)[0] for sign in (1.0, -1.0))
        np.testing.assert_allclose(gradients @ axis, (ahead - behind) / 2e-5, atol=SAME_SLOPE)


@pytest.mark.parametrize("N", [1, 4])
def test_margins_are_in_the_order_of_the_bodies(N: int) -> None:
    """UAVs keep the margin of their centres, rods and payload that of the load."""
    obstacle = Obstacle(name="", solids=(), margin_m=0.3, load_margin_m=0.1, penalty=1.0)
    expected = [0.3 if body.startswith("UAV") else 0.1 for body in bodies(N)]
    assert obstacle.margins(N).tolist() == expected
