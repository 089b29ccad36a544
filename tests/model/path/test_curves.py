"""Shapes of curves and their speed, by hand; their derivatives are in test_flatness.py."""

from dataclasses import replace

import numpy as np
import pytest

from tests.model.path.test_flatness import CURVES, ROUNDING
from transport.model.arrays import Array
from transport.model.path.curves import Curve, ShapeKind

SIZE_I = np.array([2.0, 1.0, 0.5])
# Of a polygon through the points at which the speed is sought.
SAMPLED = 1e-5


def curve(kind: str, laps: float = 1.5) -> Curve:
    """Return a circle, an eight or a straight curve of that size, from rest to rest in 8 s."""
    size_I = tuple(SIZE_I.tolist())
    shape: dict[str, ShapeKind] = {"circle": "circle", "eight": "eight"}
    return Curve(kind=shape.get(kind), duration_s=8.0, ramp_s=3.0, size_I=size_I, laps=laps)


@pytest.mark.parametrize("kind", ["circle", "eight", "straight"])
def test_shape_over_the_covered_share(kind: str) -> None:
    """With phi of 2 pi laps s: a sin phi, b (1 - cos phi) or b sin 2 phi, c sin phi; straight: s times the size."""
    t_s = np.linspace(-1.0, 9.0, 41)
    one = curve(kind)
    s = one.covered(t_s, 1)[0]
    phi = 2.0 * np.pi * 1.5 * s
    across = 1.0 - np.cos(phi) if kind == "circle" else np.sin(2.0 * phi)
    shape = np.column_stack([np.sin(phi), across, np.sin(phi)])
    if kind == "straight":
        shape = np.column_stack([s, s, s])
    np.testing.assert_allclose(one.path(t_s, 1)[0], SIZE_I * shape, atol=ROUNDING)
    assert (s[0], s[-1]) == (0.0, pytest.approx(1.0, abs=ROUNDING))


@pytest.mark.parametrize(
    ("kind", "expected_m"),
    [
        ("circle", 3.0 * np.pi * np.hypot(2.0, 0.5)),  # where cos phi is 1
        ("eight", 3.0 * np.pi * np.sqrt(2.0**2 + 2.0**2 + 0.5**2)),  # at its centre
        ("straight", float(np.linalg.norm(SIZE_I))),
    ],
)
def test_largest_speed_by_hand(kind: str, expected_m: float) -> None:
    """The largest derivative of the place by the covered share."""
    assert curve(kind).fastest() == pytest.approx(expected_m, rel=SAMPLED)


@pytest.mark.parametrize("kind", [kind for kind in CURVES if kind != "table"])
def test_with_another_ramp_the_places_are_the_same(kind: str) -> None:
    """The ramp changes when, not where: places and speed along the shape are those of the covered share."""
    one = CURVES[kind]
    other = replace(one, duration_s=2.0 * one.duration_s, ramp_s=one.duration_s)
    ends = [each.path(np.array([0.0, each.duration_s]), 1)[0] for each in (one, other)]
    middles = [each.path(np.array([each.duration_s / 2.0]), 1)[0] for each in (one, other)]
    np.testing.assert_allclose(ends[0], ends[1], atol=ROUNDING)
    np.testing.assert_allclose(middles[0], middles[1], atol=ROUNDING)
    assert one.fastest() == other.fastest()


def test_a_table_ends_where_its_rows_end() -> None:
    """The smoothed table begins at zero and holds its last row, not that of a least square."""
    table: Array = np.array([[0.0, 0, 0, 0], [3.0, 1.0, 0.5, -0.2], [6.0, 2.0, 0.0, 0.3]])
    smooth = Curve(kind=None, duration_s=6.0, ramp_s=0.0, table=table.tolist())
    ends = smooth.path(np.array([-1.0, 0.0, 6.0, 7.0]), 1)[0]
    expected = [np.zeros(3)] * 2 + [table[-1, 1:]] * 2
    np.testing.assert_allclose(ends, expected, atol=ROUNDING)


def test_a_table_of_a_second_has_the_shape_of_a_longer_one() -> None:
    """Its spline has as many knots, however short it is: the places are those of the same way in three seconds."""
    tau = np.linspace(0.0, 1.0, 41)
    s = tau**3 * (10.0 - 15.0 * tau + 6.0 * tau**2)
    ways = []
    for duration_s in (0.5, 3.0):
        table = np.column_stack([tau * duration_s, s, np.sin(np.pi * s) ** 2, -0.5 * s])
        one = Curve(kind=None, duration_s=duration_s, ramp_s=0.0, table=table.tolist())
        ways.append(one.path(tau * duration_s, 1)[0])
    np.testing.assert_allclose(ways[0], ways[1], atol=ROUNDING)
    assert np.abs(ways[0] - table[:, 1:]).max() < 0.05


@pytest.mark.parametrize("points", [[[2.0, 0.0, 1.0]], [[1.0, 0.0, 0.0], [1.0, 1.0, -1.0]]])
@pytest.mark.parametrize("times_s", [None, [3.0, 8.0]], ids=["by distance", "by time"])
def test_through_few_way_points_the_shape_is_a_polynomial(
    points: list[list[float]], times_s: list[float] | None
) -> None:
    """Of the covered share: straight to one way point, a parabola through two."""
    times_s = None if times_s is None else times_s[-len(points) :]
    one = Curve(kind="spline", duration_s=8.0, ramp_s=3.0, points_I=points, times_s=times_s)
    through = np.vstack([np.zeros(3), points])
    if times_s is None:
        shares = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(through, axis=0), axis=1)))
        shares /= shares[-1]
    else:
        shares = one.covered(np.array([0.0, *times_s]), 1)[0]
    powers = np.linalg.solve(np.vander(shares), through)

    t_s = np.linspace(0.0, 8.0, 33)
    s = one.covered(t_s, 1)[0]
    expected = np.vander(s, len(through)) @ powers
    np.testing.assert_allclose(one.path(t_s, 1)[0], expected, atol=ROUNDING)
