"""Exact zero-order hold of the affine linearisation, x' = f + A_c dx + B_c du, over one sampling period.

[A B f_d] come from one matrix exponential. With Phi = integral of exp(A_c s) ds over the period,

    A = I + A_c Phi,   B = Phi B_c,   f_d = Phi f,

so a Taylor series of Phi (n x n) replaces the exponential of the (n + m + 1)-sized augmented matrix. The
number of terms follows from the remainder bound, and periods that are long for the system are halved
until the series is short, then doubled back.
"""

import math
from dataclasses import dataclass

import numpy as np

from model.arrays import Array, ShapeError
from model.linearisation import Linearisation

_THETA_MAX = 2.0  # norm of A_c T above which the period is halved: keeps the series short, free of cancellation
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
    """Discretise with the input held over the period; no approximation beyond rounding.

    Args:
        linear: Expansion about (x0, u0).
        period_s: Sampling period T_s, > 0, s.
    Returns: A, B, f_d.
    Raises: ShapeError: A_c holds numbers that are not finite.
    Source: docs/equations.md (16)-(17).
    """
    A_c = linear.A_c
    norm = float(np.abs(A_c).sum(axis=0).max()) * period_s
    if not math.isfinite(norm):
        raise ShapeError("A_c: expected finite numbers, got nan or inf")
    halvings = max(0, math.ceil(math.log2(norm / _THETA_MAX))) if norm > 0.0 else 0
    T = period_s / 2**halvings
    # Row-major for the products below; CasADi hands out column-major.
    A_c = np.ascontiguousarray(A_c)
    identity = np.eye(A_c.shape[0])
    Phi = T * _integrated_exponential(A_c * T, identity, _terms(norm / 2**halvings))
    for _ in range(halvings):
        # exp(2 A T) has Phi(2T) = Phi(T) + exp(A T) Phi(T).
        Phi = 2.0 * Phi + (A_c @ Phi) @ Phi
    return Discrete(A=identity + A_c @ Phi, B=Phi @ linear.B_c, f_d=Phi @ linear.f)


def _integrated_exponential(X: Array, identity: Array, terms: int) -> Array:
    """sum_{k < terms} X^k / (k+1)!, four terms for each product of matrices (Paterson, Stockmeyer 1973)."""
    n, blocks = len(X), -(-terms // 4)
    powers = np.empty((4, n, n))
    powers[0], powers[1] = identity, X
    np.matmul(X, X, out=powers[2])
    np.matmul(powers[2], X, out=powers[3])
    X4 = powers[2] @ powers[2]
    coefficients = np.array([1.0 / math.factorial(k + 1) for k in range(4 * blocks)]).reshape(blocks, 4)
    sums = (coefficients @ powers.reshape(4, n * n)).reshape(blocks, n, n)
    total: Array = sums[-1]
    for block in range(blocks - 2, -1, -1):
        total = total @ X4 + sums[block]
    return total


def _terms(theta: float) -> int:
    """Smallest K with sum_{k >= K} theta^k / (k+1)! <= the permitted remainder; bounded by a geometric series."""
    K = 2
    term = theta**2 / 6.0
    while term / (1.0 - theta / (K + 2)) > _REMAINDER:
        K += 1
        term *= theta / (K + 1)
    return K
