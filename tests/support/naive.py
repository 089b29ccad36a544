"""The paper's stacked matrices, built block by block as in section III.

Slow, but a direct transcription.

Every stack has N_p + 1 block rows, one more than (16) as published: the last one is step k + N_p,
which the terminal cost of (17) and (25) needs.
"""

import numpy as np
from scipy.linalg import block_diag, expm

from transport.model.arrays import Array
from transport.model.linear.linearisation import Linearisation


def exact_hold(linear: Linearisation, period_s: float) -> tuple[Array, Array, Array]:
    """Return A, B and the drift per step of (14) from the exponential of the augmented matrix.

    The published drift f(x0, u0) T_s belongs to an Euler step. With A and B of a zero-order hold
    the drift is the integral that the same exponential contains.
    """
    n, m = linear.B_c.shape
    augmented = np.zeros((n + m + 1, n + m + 1))
    augmented[:n] = np.column_stack([linear.A_c, linear.B_c, linear.f])
    hold = expm(augmented * period_s)
    return hold[:n, :n], hold[:n, n : n + m], hold[:n, n + m]


def stacked_drift(A: Array, f_d: Array, steps: int) -> Array:
    """Return F of (16): block k is sum_{j=1}^{k} A^(j-1) f_d, ((steps + 1) n,)."""
    blocks = [
        sum(
            (np.linalg.matrix_power(A, j - 1) @ f_d for j in range(1, k + 1)),
            start=np.zeros(len(f_d)),
        )
        for k in range(steps + 1)
    ]
    return np.concatenate(blocks)


def stacked_state(A: Array, steps: int) -> Array:
    """Return G of (16): block k is A^k, ((steps + 1) n, n)."""
    return np.vstack([np.linalg.matrix_power(A, k) for k in range(steps + 1)])


def stacked_input(A: Array, B: Array, steps: int) -> Array:
    """Return H of (16), or H_i of (24) for the columns B_i.

    Block (k, j) is A^(k-1-j) B below the diagonal.
    """
    n, m = B.shape
    H = np.zeros(((steps + 1) * n, steps * m))
    for k in range(steps + 1):
        for j in range(k):
            H[k * n : (k + 1) * n, j * m : (j + 1) * m] = np.linalg.matrix_power(A, k - 1 - j) @ B
    return H


def stacked_output(C: Array, steps: int) -> Array:
    """Return C-bar of (16), block diagonal over steps 0..N_p."""
    return np.asarray(block_diag(*[C] * (steps + 1)))


def stacked_weight(Q: Array, Q_f: Array, steps: int) -> Array:
    """Return Q-bar of (17) with the terminal weight as its last block.

    Weights are given as diagonals.
    """
    return np.diag(np.concatenate([np.tile(Q, steps), Q_f]))


def simulate(A: Array, B: Array, f_d: Array, dU: Array) -> Array:
    """Return dx with dx(0) = 0 and dx(k+1) = f_d + A dx(k) + B du(k) of (14), step by step, (steps + 1, n)."""
    dX = [np.zeros(len(f_d))]
    for du in dU:
        dX.append(f_d + A @ dX[-1] + B @ du)
    return np.array(dX)
