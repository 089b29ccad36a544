"""Zero-order hold of x' = f + A_c dx + B_c du.

A Taylor series applied to [A_c B_c f], with A_c in factors.
"""

from functools import lru_cache

import msgspec
import numpy as np

from transport.model.arrays import Array, ShapeError
from transport.model.kernels import native
from transport.model.linear.linearisation import Linearisation

# theta = max(b_2^(1/2), b_3^(1/3)) stands for the norm of X = A_c T, with b_k the largest column sum
# of |X|^k, entry by entry: every k >= 2 is a sum of twos and threes, so |X^k| <= theta^k, and for
# a mechanical system theta is several times smaller than |X| (Al-Mohy, Higham 2009).
_THETA_MAX = 2.0  # above it the period is halved: a short series without cancellation
_THETA_POSSIBLE = 300.0  # products of exp(theta) stay far below the float64 range
_REMAINDER = 2.0**-53  # relative to T: below the rounding of the sum itself


class Discrete(msgspec.Struct, frozen=True, kw_only=True):
    """dx(k+1) = f_d + A dx(k) + B du(k) over one sampling period."""

    A: Array  # state matrix, (n, n)
    B: Array  # input matrix, (n, m)
    f_d: Array  # drift per step, (n,)
    # Numbers of halvings and of terms of the series, (2,): those of A_c; None where there is no series.
    length: native.Places | None = None


def zero_order_hold(
    linear: Linearisation,
    period_s: float,
    known: Discrete | None = None,
    *,
    remainder: float = _REMAINDER,
) -> Discrete:
    """Discretise exactly over a period, s.

    A and B of a known hold are kept, and the length of its series; only the drift of another f is
    computed.
    Raises: ShapeError: A_c is not finite, or too large for exp(A_c T_s).
    Source: docs/equations.md (16), (17).
    """
    if not native.AVAILABLE:
        return by_exponential(linear, period_s)

    jacobians = linear.jacobians
    n, m = jacobians.pattern.shapes[1]
    _, accelerations = jacobians.pattern.shapes[2]
    sizes = n, m, accelerations
    if known is None or known.length is None:
        is_known = False
        A, B, length = np.empty((n, n)), np.empty((n, m)), np.empty(2, dtype=np.intp)
    else:
        is_known = True
        A, B, length = known.A, known.B, known.length
    f_d = np.empty(n)

    theta = native.KERNELS.zero_order_hold(
        *sizes,
        *jacobians.pattern.addresses,
        jacobians.address,
        native.address(linear.f),
        period_s,
        _THETA_MAX,
        _THETA_POSSIBLE,
        remainder,
        is_known,
        native.address(length),
        0 if is_known else native.address(A),  # known ones are not written
        0 if is_known else native.address(B),
        native.address(f_d),
        _work_space(*sizes),
    )
    _check_growth(theta, period_s)
    return Discrete(A=A, B=B, f_d=f_d, length=length)


@lru_cache
def _work_space(n: int, m: int, accelerations: int) -> int:
    """Return the address of the kernel's work space."""
    return native.work("hold", native.KERNELS.zero_order_hold_work(n, m, accelerations))


def by_exponential(linear: Linearisation, period_s: float) -> Discrete:
    """Return the hold as the exponential of the augmented matrix: [A B f_d] of (16)."""
    from scipy.linalg import expm  # 0.3 s at start, only without compiled kernels

    # theta of (17): the largest column sums of |X|^2 and |X|^3.
    X = np.abs(linear.A_c) * period_s
    with np.errstate(over="ignore", invalid="ignore"):
        sums = X.sum(axis=0) @ X
        theta = np.maximum(sums.max() ** (1 / 2), (sums @ X).max() ** (1 / 3))
        _check_growth(float(theta), period_s)

    n, m = linear.B_c.shape
    augmented = np.zeros((n + m + 1, n + m + 1))
    augmented[:n] = np.column_stack([linear.A_c, linear.B_c, linear.f])
    held = expm(augmented * period_s)[:n]
    return Discrete(
        A=np.ascontiguousarray(held[:, :n]),
        B=np.ascontiguousarray(held[:, n:-1]),
        f_d=held[:, -1].copy(),
    )


def euler(linear: Linearisation, period_s: float) -> Discrete:
    """Discretise by one step of Euler's method, for comparison.

    Raises: ShapeError: A_c is not finite.
    """
    if not np.isfinite(linear.A_c).all():
        raise ShapeError("A_c: expected finite numbers")
    A = np.eye(len(linear.A_c)) + period_s * linear.A_c
    return Discrete(A=A, B=period_s * linear.B_c, f_d=period_s * linear.f)


def _check_growth(theta: float, period_s: float) -> None:
    """Check that the exponential of A_c T_s is finite. Raises: ShapeError."""
    if not theta <= _THETA_POSSIBLE:
        growth = f"growth by exp({theta:g}) in {period_s:g} s"
        raise ShapeError(f"A_c: expected finite numbers with a finite exponential, got {growth}")
