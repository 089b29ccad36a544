"""Condensing: Hessian, gradient and constraint rows in terms of the decision alone.

The prediction matrix is block-Toeplitz, so the Hessian's blocks along each diagonal, and likewise the gradient's, are
partial sums of the same products: O(N_p^2) blocks of work instead of O(N_p^3) for the matrix products of paper (16).
"""

import itertools
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from model import native
from model.arrays import Array


def hessian(output_impulse: Array, Q: Array, terminal: float) -> Array:
    """Return sum_{k=1}^{N_p-1} G_k' Q G_k + terminal G_Np' Q G_Np, (N_p m, N_p m); G_k: effect of the decision on y(k).

    Block (i, j) sums S_a' Q S_b over b = 0, 1, .. with a - b = j - i fixed: one matrix product for all pairs, then sums
    along its block diagonals. Weights Q, (p,), and Q_f as a multiple `terminal` of it. Source: docs/equations.md (26).
    """
    steps, p, m = output_impulse.shape
    S = output_impulse.transpose(1, 0, 2).reshape(p, steps * m)
    # Blocks side by side in memory, so that a row of them is one contiguous sum.
    sums = np.ascontiguousarray((S.T @ (Q[:, None] * S)).reshape(steps, m, steps, m).transpose(0, 2, 1, 3))
    blocks = terminal * sums
    for above, below in itertools.pairwise(sums):
        below[1:] += above[:-1]
    # Step k = N_p has the weight Q_f alone, so the sums with Q end one step earlier.
    blocks[1:, 1:] += sums[:-1, :-1]
    H = blocks[::-1, ::-1].transpose(0, 2, 1, 3).reshape(steps * m, steps * m)
    return (H + H.T) / 2.0


def gradient(output_impulse: Array, weighted: Array) -> Array:
    """Return sum_k G_k' w(k), (N_p m,); weighted errors of steps 1..N_p, (N_p, p). Source: docs/equations.md (27)."""
    return weighted.reshape(-1) @ rows(output_impulse)


def fill(effect: Array, to: Array) -> None:
    """Write the prediction matrix of a signal (`rows`) into the first columns of zero rows, (N_p s, at least N_p m).

    Given is the effect of decisions on the signal, signal by signal, (s, N_p, m). The rows are whole rows of a
    row-major matrix.
    """
    if native.AVAILABLE:
        native.toeplitz(np.ascontiguousarray(effect), to)
    else:
        to[:, : effect.shape[1] * effect.shape[2]] = rows(effect.transpose(1, 0, 2))


def rows(impulse: Array) -> Array:
    """Return the prediction matrix of a signal at steps 1..N_p, lower block-Toeplitz, (N_p s, N_p m).

    Args:
        impulse: Effect of one decision on the signal j + 1 steps later, (N_p, s, m).
    Source: docs/equations.md (25); paper (16).
    """
    steps, s, m = impulse.shape
    padded = np.concatenate([impulse, np.zeros((1, s, m))])
    return padded[_later(steps)].transpose(0, 2, 1, 3).reshape(steps * s, steps * m)


@lru_cache
def _later(steps: int) -> npt.NDArray[np.intp]:
    """Return the steps from decision (column) to signal (row); the number of steps if the decision comes later."""
    later = np.arange(steps)[:, None] - np.arange(steps)[None, :]
    return np.where(later < 0, steps, later)
