"""Exact zero-order hold of the affine linearisation, x' = f + A_c dx + B_c du, over one sampling period.

[A B f_d] come from one matrix exponential. With Phi = integral of exp(A_c s) ds over the period,

    A = I + A_c Phi,   B = Phi B_c,   f_d = Phi f,

so a Taylor series of Phi, (n, n), replaces the exponential of an augmented matrix of size n + m + 1. The number of
terms follows from the remainder bound; long periods are halved until the series is short, then doubled back.
"""

import math
from dataclasses import dataclass

import numpy as np

from model import native
from model.arrays import Array, ShapeError
from model.linearisation import Linearisation

_THETA_MAX = 2.0  # theta (see _terms) above which the period is halved: a short series without cancellation
_THETA_POSSIBLE = 300.0  # products of exp(theta) stay far below the float64 range
_REMAINDER = 2.0**-53  # relative to T: below the rounding of the sum itself


@dataclass(frozen=True, slots=True, kw_only=True)
class Discrete:
    """dx(k+1) = f_d + A dx(k) + B du(k) over one sampling period.

    Attributes:
        A: State matrix, (n, n).
        B: Input matrix, (n, m).
        f_d: Drift per step, (n,).
    """

    A: Array
    B: Array
    f_d: Array


def zero_order_hold(linear: Linearisation, period_s: float) -> Discrete:
    """Discretise with the input held over the period, exact but for rounding.

    Args:
        linear: Expansion about (x0, u0).
        period_s: Sampling period T_s, > 0, s.
    Raises: ShapeError: A_c or its exponential is not finite.
    Source: docs/equations.md (16)-(17).
    """
    if native.AVAILABLE:
        theta, A, B, f_d = native.zero_order_hold(
            linear.A_c, linear.B_c, linear.f, period_s, _THETA_MAX, _THETA_POSSIBLE, _REMAINDER
        )
        _check_growth(theta, period_s)
        return Discrete(A=A, B=B, f_d=f_d)
    return _zero_order_hold(linear, period_s)


def _zero_order_hold(linear: Linearisation, period_s: float) -> Discrete:
    # Row-major for the products below; CasADi hands out column-major.
    A_c = np.ascontiguousarray(linear.A_c)
    X = A_c * period_s
    powers = np.empty((4, *X.shape))
    powers[0], powers[1] = np.eye(len(X)), X
    with np.errstate(over="ignore", invalid="ignore"):
        np.matmul(X, X, out=powers[2])
        np.matmul(powers[2], X, out=powers[3])
        theta = float(np.maximum(_norm(powers[2]) ** (1 / 2), _norm(powers[3]) ** (1 / 3)))
    _check_growth(theta, period_s)
    halvings = max(0, math.ceil(math.log2(theta / _THETA_MAX))) if theta > 0.0 else 0
    T = period_s / 2**halvings
    for k in (1, 2, 3):
        powers[k] /= 2 ** (k * halvings)
    Phi = T * _integrated_exponential(powers, _terms(theta / 2**halvings))
    for _ in range(halvings):
        # exp(2 A T) has Phi(2T) = Phi(T) + exp(A T) Phi(T).
        Phi = 2.0 * Phi + (A_c @ Phi) @ Phi
    return Discrete(A=np.eye(len(X)) + A_c @ Phi, B=Phi @ linear.B_c, f_d=Phi @ linear.f)


def euler(linear: Linearisation, period_s: float) -> Discrete:
    """Discretise by one step of Euler's method, for comparison; error per step of order T_s^2.

    Args:
        linear: Expansion about (x0, u0).
        period_s: Sampling period T_s, > 0, s.
    Raises: ShapeError: A_c is not finite.
    """
    if not np.isfinite(linear.A_c).all():
        raise ShapeError("A_c: expected finite numbers")
    A = np.eye(len(linear.A_c)) + period_s * linear.A_c
    return Discrete(A=A, B=period_s * linear.B_c, f_d=period_s * linear.f)


def _check_growth(theta: float, period_s: float) -> None:
    if not theta <= _THETA_POSSIBLE:
        growth = f"growth by exp({theta:g}) in {period_s:g} s"
        raise ShapeError(f"A_c: expected finite numbers with a finite exponential, got {growth}")


def _norm(X: Array) -> float:
    """Return the largest column sum of magnitudes."""
    return float(np.abs(X).sum(axis=0).max())


def _integrated_exponential(powers: Array, terms: int) -> Array:
    """Return sum_{k < terms} X^k / (k+1)!, four terms per matrix product (Paterson, Stockmeyer 1973).

    Args:
        powers: I, X, X^2, X^3, (4, n, n).
        terms: Their number.
    """
    n, blocks = powers.shape[1], -(-terms // 4)
    coefficients = np.array([1.0 / math.factorial(k + 1) for k in range(4 * blocks)]).reshape(blocks, 4)
    sums = (coefficients @ powers.reshape(4, n * n)).reshape(blocks, n, n)
    total: Array = sums[-1]
    if blocks > 1:
        X4 = powers[2] @ powers[2]
        for block in range(blocks - 2, -1, -1):
            total = total @ X4 + sums[block]
    return total


def _terms(theta: float) -> int:
    """Return the smallest K >= 2 with sum_{k >= K} theta^k / (k+1)! <= _REMAINDER, bounded by a geometric series.

    theta = max(|X^2|^(1/2), |X^3|^(1/3)) stands for the norm: every k >= 2 is a sum of twos and threes, so
    |X^k| <= theta^k, and for a mechanical system (positions feed on velocities, not the other way) it is
    several times smaller than |X| (Al-Mohy, Higham 2009).
    """
    K = 2
    term = theta**2 / 6.0
    while term / (1.0 - theta / (K + 2)) > _REMAINDER:
        K += 1
        term *= theta / (K + 1)
    return K
