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

_THETA_MAX = 1.0  # norm of A_c T above which the period is halved: keeps the series free of cancellation
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
    X = np.ascontiguousarray(A_c) * T
    identity = np.eye(X.shape[0])
    terms = _terms(norm / 2**halvings)
    # Horner: Phi = T (I + X/2 (I + X/3 (... (I + X/terms)))).
    Phi = identity + X / terms
    for k in range(terms - 1, 1, -1):
        Phi = identity + (X @ Phi) / k
    Phi *= T
    for _ in range(halvings):
        # exp(2 A T) has Phi(2T) = Phi(T) + exp(A T) Phi(T).
        Phi = 2.0 * Phi + (A_c @ Phi) @ Phi
    return Discrete(A=identity + A_c @ Phi, B=Phi @ linear.B_c, f_d=Phi @ linear.f)


def _terms(theta: float) -> int:
    """Smallest K with sum_{k >= K} theta^k / (k+1)! <= the permitted remainder; bounded by a geometric series."""
    K = 2
    term = theta**2 / 6.0
    while term / (1.0 - theta / (K + 2)) > _REMAINDER:
        K += 1
        term *= theta / (K + 1)
    return K
