"""Smooth curves of the payload.

P(s(t)), a shape over the covered share s, from rest to rest, and its derivatives.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import factorial
from typing import Any, Literal

import numpy as np
from numpy.polynomial import Polynomial

from transport.model import jets
from transport.model.arrays import Array

ShapeKind = Literal["circle", "eight", "spline"]

ORDERS = 7  # coefficients of a jet up to the highest derivative that moments of UAVs need
_FLAT = ORDERS - 1  # derivatives of s' up to this order vanish at both ends
_DEGREE = 7  # of splines: the sixth derivative is continuous between way points; minimum snap
# Distance of the knots of a smoothed table, s, their least number, and samples of the table between
# two of them.
_KNOTS_S, _FEWEST_KNOTS, _PER_KNOT = 0.25, 2 * _DEGREE, 8
_SAMPLES = 2000  # points of a shape at which its largest speed is sought

_bell = Polynomial([0.0, 1.0]) ** _FLAT * Polynomial([1.0, -1.0]) ** _FLAT
_step = _bell.integ()
# Integral of the smooth step from 0 to 1, on its first half.
_START = (_step / _step(1.0)).integ()


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A shape and its timing.

    Circle (a sin, b (1 - cos), c sin) of 2 pi laps s, eight with b sin of twice that.
    """

    kind: ShapeKind | None
    duration_s: float  # from rest to rest
    ramp_s: float  # time of speeding up, and of slowing down, at most half the duration
    size_I: tuple[float, ...] = (
        0.0,
        0.0,
        0.0,
    )  # a, b, c of circle and eight, m; the displacement of a straight curve
    laps: float = 1.0  # of circle and eight
    points_I: Sequence[
        Sequence[float]
    ] = ()  # way points of a spline after its start at zero, (k, 3), m
    times_s: Sequence[float] | None = (
        None  # of them; None: s is proportional to the distance between way points
    )
    # Times and displacements since the start, (k, 4), s and m, instead of shape and timing: the
    # closest spline.
    table: Sequence[Sequence[float]] = ()

    def path(self, t_s: Array, orders: int = ORDERS) -> Array:
        """Return the jets of the displacement since the start at times since then, (k,).

        (orders, k, 3), m, SI.
        """
        if len(self.table):
            inside = np.clip(t_s, 0.0, self.duration_s)
            return np.array(
                [self._smoothed(inside, order) / factorial(order) for order in range(orders)]
            )
        return self._shape(self.covered(t_s, orders))

    def covered(self, t_s: Array, orders: int) -> Array:
        """Return the jets of the covered share s, (orders, k). Source: docs/equations.md (65)."""
        span = self.duration_s - self.ramp_s
        inside = np.clip(t_s, 0.0, self.duration_s)
        s = (
            _started(inside, self.ramp_s, orders) - _started(inside - span, self.ramp_s, orders)
        ) / span
        s[1:, inside != t_s] = 0.0
        return s

    def fastest(self) -> float:
        """Return the largest speed along the shape per unit of s, m."""
        s = np.zeros((2, _SAMPLES + 1))
        s[0], s[1] = np.linspace(0.0, 1.0, _SAMPLES + 1), 1.0
        return float(np.linalg.norm(self._shape(s)[1], axis=-1).max())

    def _shape(self, s: Array) -> Array:
        if self.kind == "spline":
            values = [self._spline(s[0], order) / factorial(order) for order in range(len(s))]
            return jets.composed(np.array(values), s)
        if self.kind is None:
            return np.asarray(s[..., None] * np.array(self.size_I))
        angle = 2.0 * np.pi * self.laps * s
        a, b, c = self.size_I
        sin = jets.sine(angle)
        if self.kind == "eight":
            across = b * jets.sine(2.0 * angle)
        else:
            across = -b * jets.sine(angle, np.pi / 2.0)
            across[0] += b
        return np.stack([a * sin, across, c * sin], axis=-1)

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import make_interp_spline  # 0.3 s at start, and only splines need it

        points = np.vstack([np.zeros(3), np.asarray(self.points_I, dtype=np.float64)])
        if self.times_s is None:
            s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
            s /= s[-1]
        else:
            s = self.covered(np.array([0.0, *self.times_s]), 1)[0]
        if (
            len(points) <= _DEGREE // 2
        ):  # the polynomial through them has no snap, but is not the only such spline
            return make_interp_spline(s, points, k=len(points) - 1)
        # Minimum snap with free ends; start and stop are those of s.
        ends = [(order, np.zeros(3)) for order in range((_DEGREE + 1) // 2, _DEGREE)]
        return make_interp_spline(s, points, k=_DEGREE, bc_type=(ends, ends))

    @cached_property
    def _smoothed(self) -> Any:
        """Spline of the table: all its derivatives vanish at both ends, its last point is that of the table."""
        from scipy.interpolate import BSpline
        from scipy.linalg import solveh_banded

        table, d = np.asarray(self.table, dtype=np.float64), _DEGREE
        pieces = max(int(np.ceil(self.duration_s / _KNOTS_S)), _FEWEST_KNOTS)
        inner = np.linspace(0.0, self.duration_s, pieces + 1)
        knots = np.concatenate([np.zeros(d), inner, np.full(d, self.duration_s)])
        t_s = np.linspace(0.0, self.duration_s, _PER_KNOT * pieces + 1)
        places = np.column_stack([np.interp(t_s, table[:, 0], column) for column in table[:, 1:].T])
        basis, points = BSpline.design_matrix(t_s, knots, d).tocsc(), np.zeros((pieces + d, 3))
        points[-d:] = table[-1, 1:]
        free = basis[:, d:-d]
        # Sparse products and a banded solution do not depend on the number of threads.
        squares = (free.T @ free).toarray()
        bands = np.array([np.pad(np.diagonal(squares, -i), (0, i)) for i in range(d + 1)])
        points[d:-d] = solveh_banded(
            bands, free.T @ (places - basis[:, -d:] @ points[-d:]), lower=True
        )
        return BSpline(knots, points, d)


def _started(t_s: Array, ramp_s: float, orders: int) -> Array:
    """Return the jets of the time since a smooth start over `ramp_s`, less half of it from then on, (orders, k), s."""
    x = t_s / ramp_s
    low, high = np.clip(x, 0.0, 0.5), np.clip(1.0 - x, 0.0, 0.5)
    # The second half mirrors the first: better conditioned than the polynomial near its other end.
    first, second = (
        jets.of_polynomial(_START, low, orders),
        jets.of_polynomial(_START, high, orders),
    )
    signs = (-1.0) ** np.arange(orders)[:, None]
    second = second * signs
    second[0] += x - 0.5
    second[1:2] += 1.0
    ramp = np.where(x < 0.5, first, second)
    return np.asarray(ramp_s * ramp / ramp_s ** np.arange(orders, dtype=np.float64)[:, None])
