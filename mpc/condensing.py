"""Condensing: Hessian, gradient and constraint rows of the cost in the decision alone.

The prediction matrix is block-Toeplitz, so the Hessian's blocks along each diagonal are partial sums of
the same products, and the gradient is one backward sweep. The work is O(N_p^2) blocks; forming the
matrices of paper (16) and multiplying them, the oracle of the tests, is O(N_p^3).
"""

import numpy as np

from model.arrays import Array


def hessian(output_impulse: Array, Q: Array, Q_f: Array) -> Array:
    """sum_{k=1}^{N_p-1} G_k' Q G_k + G_Np' Q_f G_Np, with G_k the effect of the decision on y(k).

    Block (i, j) sums S_a' Q S_b over b = 0, 1, .. with a - b = j - i fixed, S the impulse response; the
    products of all pairs are one matrix product, the sums run down its block diagonals.

    Args:
        output_impulse: S_j = C A^j B, (N_p, p, m).
        Q: Stage weight, (p,).
        Q_f: Terminal weight, (p,).
    Returns: (N_p m, N_p m), symmetric.
    Source: docs/equations.md (26).
    """
    steps, p, m = output_impulse.shape
    S = output_impulse.transpose(1, 0, 2).reshape(p, steps * m)
    # Blocks side by side in memory, so that a row of them is one contiguous sum.
    sums = np.ascontiguousarray((S.T @ (Q[:, None] * S)).reshape(steps, m, steps, m).transpose(0, 2, 1, 3))
    for a in range(1, steps):
        sums[a, 1:] += sums[a - 1, :-1]
    blocks = (S.T @ (Q_f[:, None] * S)).reshape(steps, m, steps, m).transpose(0, 2, 1, 3).copy()
    # Step k = N_p is priced by Q_f alone, so Q's sums end one step earlier.
    blocks[1:, 1:] += sums[:-1, :-1]
    H = blocks[::-1, ::-1].transpose(0, 2, 1, 3).reshape(steps * m, steps * m)
    return (H + H.T) / 2.0


def gradient(A: Array, B: Array, forces: Array) -> Array:
    """sum_k G_k' w(k) by the adjoint recursion l(k) = A' l(k+1) + C' w(k), block j = B' l(j+1).

    Args:
        A: State matrix of the prediction, (n, n).
        B: Effect of the decision, (n, m).
        forces: C' w(k) at steps 1..N_p, (N_p, n), w the weighted error of the free response.
    Returns: (N_p m,).
    Source: docs/equations.md (27).
    """
    adjoint = np.empty_like(forces)
    adjoint[-1] = forces[-1]
    for k in range(len(forces) - 2, -1, -1):
        adjoint[k] = adjoint[k + 1] @ A + forces[k]
    return (adjoint @ B).reshape(-1)


def rows(impulse: Array) -> Array:
    """Prediction matrix of a signal at steps 1..N_p from its impulse response (lower block-Toeplitz).

    Args:
        impulse: Effect of one decision on the signal j + 1 steps later, (N_p, s, m).
    Returns: (N_p s, N_p m), step by step.
    Source: docs/equations.md (25); paper (16).
    """
    steps, s, m = impulse.shape
    later = np.arange(steps)[:, None] - np.arange(steps)[None, :]
    padded = np.concatenate([impulse, np.zeros((1, s, m))])
    return padded[np.where(later < 0, steps, later)].transpose(0, 2, 1, 3).reshape(steps * s, steps * m)
