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

from transport.model.arrays import Array
from transport.model.path import taylor_jets as jets

ShapeKind = Literal["circle", "eight", "spline"]

ORDERS = 7  # coefficients of a jet up to the highest derivative that moments of UAVs need
_FLAT = ORDERS - 1  # derivatives of s' up to this order vanish at both ends
_DEGREE = 7  # of splines: the sixth derivative is continuous between way points; minimum snap
_KNOTS_S = 0.25  # distance of the knots of a smoothed table, s
_FEWEST_KNOTS = 2 * _DEGREE
_SAMPLES_PER_KNOT = 8  # of the table, to which the spline is fitted
_SAMPLES = 2000  # points of a shape at which its largest speed is sought

# S of (65), the integral of x^6 (1 - x)^6 that ends at 1, and its own integral.
_x = Polynomial([0.0, 1.0])
_bell = _x**_FLAT * (1.0 - _x) ** _FLAT
_S = _bell.integ() / _bell.integ()(1.0)
_J = _S.integ()
# Coefficients of the derivatives of J, (orders, degree + 1), and what makes Taylor coefficients of derivatives.
_DERIVATIVES_OF_J = np.zeros((_J.degree() + 1, _J.degree() + 1))
for _order in range(len(_DERIVATIVES_OF_J)):
    _coefficients = _J.deriv(_order).coef
    _DERIVATIVES_OF_J[_order, : len(_coefficients)] = _coefficients
_FACTORIALS = np.array([float(factorial(order)) for order in range(len(_DERIVATIVES_OF_J))])


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A shape and its timing.

    Circle (a sin, b (1 - cos), c sin) of 2 pi laps s, eight with b sin of twice that.
    """

    kind: ShapeKind | None  # None: straight, or the table
    duration_s: float  # from rest to rest
    ramp_s: float  # time of speeding up, and of slowing down, at most half the duration
    # a, b, c of circle and eight, m; the displacement of a straight curve.
    size_I: tuple[float, ...] = (0.0, 0.0, 0.0)
    laps: float = 1.0  # of circle and eight
    # Way points of a spline after its start at zero, (k, 3), m.
    points_I: Sequence[Sequence[float]] = ()
    # Times of the way points; None: s is proportional to the distance between them.
    times_s: Sequence[float] | None = None
    # Times and displacements since the start, (k, 4), s and m, instead of shape and timing: the
    # closest spline.
    table: Sequence[Sequence[float]] = ()

    def path(self, t_s: Array, orders: int = ORDERS) -> Array:
        """Return the jets of the displacement since the start at times since then, (k,), s.

        (orders, k, 3), SI.
        """
        if len(self.table):
            inside = np.clip(t_s, 0.0, self.duration_s)
            return _taylor(self._smoothed, inside, orders)
        return self._shape(self.covered(t_s, orders))

    def covered(self, t_s: Array, orders: int) -> Array:
        """Return the jets of the covered share s, (orders, k). Source: docs/equations.md (65)."""
        # s' = (S(t / t_r) - S((t - T + t_r) / t_r)) / (T - t_r), integrated.
        span_s = self.duration_s - self.ramp_s
        inside = np.clip(t_s, 0.0, self.duration_s)
        since_s = np.array([inside, inside - span_s])  # since the start, and since slowing down
        integrals_s = _integral_of_ramp(since_s, self.ramp_s, orders)

        s = (integrals_s[:, 0] - integrals_s[:, 1]) / span_s
        s[1:, inside != t_s] = 0.0
        return s

    def fastest(self) -> float:
        """Return the largest speed along the shape per unit of s, m."""
        s = np.zeros((2, _SAMPLES + 1))
        s[0] = np.linspace(0.0, 1.0, _SAMPLES + 1)
        s[1] = 1.0
        speeds = np.linalg.norm(self._shape(s)[1], axis=-1)
        return float(speeds.max())

    def _shape(self, s: Array) -> Array:
        """Return the jets of the displacement, (orders, k, 3), by those of the covered share."""
        if self.kind == "spline":
            return jets.composed(_taylor(self._spline, s[0], len(s)), s)
        if self.kind is None:
            return np.asarray(s[..., None] * np.array(self.size_I))

        a, b, c = self.size_I
        angle = 2.0 * np.pi * self.laps * s
        sin = jets.sine(angle)
        if self.kind == "eight":
            y = b * jets.sine(2.0 * angle)  # b sin 2 phi
        else:
            y = -b * jets.sine(angle, np.pi / 2.0)  # b (1 - cos phi)
            y[0] += b
        return np.stack([a * sin, y, c * sin], axis=-1)

    @cached_property
    def _spline(self) -> Any:
        """Spline through the way points over s."""
        # 0.3 s, and only splines need it; processes at a set speed have it before their first tick.
        from scipy.interpolate import make_interp_spline

        points = np.vstack([np.zeros(3), np.asarray(self.points_I, dtype=np.float64)])
        if self.times_s is None:
            distances = np.linalg.norm(np.diff(points, axis=0), axis=1)
            s = np.concatenate([[0.0], np.cumsum(distances)])
            s /= s[-1]
        else:
            s = self.covered(np.array([0.0, *self.times_s]), 1)[0]

        # Through few points a polynomial: it has no snap, as have other splines.
        if len(points) <= _DEGREE // 2:
            return make_interp_spline(s, points, k=len(points) - 1)

        # Minimum snap with free ends; start and stop are those of s.
        ends = [(order, np.zeros(3)) for order in range((_DEGREE + 1) // 2, _DEGREE)]
        return make_interp_spline(s, points, k=_DEGREE, bc_type=(ends, ends))

    @cached_property
    def _smoothed(self) -> Any:
        """Spline with the least squared distance from the table: (65).

        All its derivatives vanish at both ends, its last point is that of the table.
        """
        from scipy.interpolate import BSpline

        table = np.asarray(self.table, dtype=np.float64)
        pieces = max(int(np.ceil(self.duration_s / _KNOTS_S)), _FEWEST_KNOTS)
        inner = np.linspace(0.0, self.duration_s, pieces + 1)
        knots = np.concatenate([np.zeros(_DEGREE), inner, np.full(_DEGREE, self.duration_s)])

        t_s = np.linspace(0.0, self.duration_s, _SAMPLES_PER_KNOT * pieces + 1)
        columns = [np.interp(t_s, table[:, 0], column) for column in table[:, 1:].T]
        places = np.column_stack(columns)

        # As many equal control points at an end as the degree make all derivatives vanish there:
        # zero at the first end, the last row of the table at the other.
        free = slice(_DEGREE, -_DEGREE)
        at_end = slice(-_DEGREE, None)
        points = np.zeros((pieces + _DEGREE, 3))
        points[at_end] = table[-1, 1:]
        basis = BSpline.design_matrix(t_s, knots, _DEGREE).tocsc()
        rest = places - basis[:, at_end] @ points[at_end]
        points[free] = _least_squares(basis[:, free], rest)
        return BSpline(knots, points, _DEGREE)


def _least_squares(basis: Any, values: Array) -> Array:
    """Return the coefficients of sparse splines with the least squared distance from values.

    Sparse products and a banded solution do not depend on the number of threads.
    """
    from scipy.linalg import solveh_banded

    # basis' basis c = basis' values, a matrix with `_DEGREE` bands below its diagonal.
    normal = (basis.T @ basis).toarray()
    bands = [np.pad(np.diagonal(normal, -below), (0, below)) for below in range(_DEGREE + 1)]
    return np.asarray(solveh_banded(np.array(bands), basis.T @ values, lower=True))


def _taylor(spline: Any, x: Array, orders: int) -> Array:
    """Return Taylor coefficients of a spline at x, (k,): (orders, k, 3)."""
    coefficients = [spline(x, order) / factorial(order) for order in range(orders)]
    return np.array(coefficients)


def _integral_of_ramp(t_s: Array, ramp_s: float, orders: int) -> Array:
    """Return the jets of t_r J(t / t_r), J the integral of S, (orders, *t_s.shape), s: (65).

    The time since a smooth start over `ramp_s`, less half of it from then on.
    """
    x = t_s / ramp_s
    orders_first = (orders, *[1] * x.ndim)
    taylor = _taylor_of_J(np.array([x, 1.0 - x]), orders)
    first_half = taylor[:, 0]

    # J(x) = x - 1/2 + J(1 - x): better conditioned than the polynomial near its other end. Each
    # derivative of J(1 - x) changes its sign.
    signs = (-1.0) ** np.arange(orders)
    from_middle = taylor[:, 1] * signs.reshape(orders_first)
    from_middle[0] += x - 0.5
    if orders > 1:
        from_middle[1] += 1.0

    # Coefficient j by t in place of x: t_r^-j.
    scales = ramp_s ** np.arange(orders, dtype=np.float64)
    integral = ramp_s * np.where(x < 0.5, first_half, from_middle)
    return np.asarray(integral / scales.reshape(orders_first))


def _taylor_of_J(x: Array, orders: int) -> Array:
    """Return Taylor coefficients of J at the nearest x from 0 to 1/2: (orders, *x.shape)."""
    x = np.clip(x, 0.0, 0.5)
    orders_first = (orders, *[1] * x.ndim)

    # Horner's scheme for all derivatives at once: the higher ones begin with zeros.
    J = np.zeros((orders, *x.shape))
    for power in reversed(range(_DERIVATIVES_OF_J.shape[1])):
        J *= x
        J += _DERIVATIVES_OF_J[:orders, power].reshape(orders_first)
    return np.asarray(J / _FACTORIALS[:orders].reshape(orders_first))
