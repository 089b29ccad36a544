"""A primal-dual active-set method for QPs with bounds only (Hintermueller, Ito, Kunisch 2003).

Guess the active bounds; solve the remaining equations; release bounds whose multiplier has the wrong sign, add violated
ones; repeat until the guess is consistent. Each guess costs one factorisation, and most QPs of a run need one guess.
The method may cycle; it then reports failure.
"""

import numpy as np

from model import native
from model.arrays import Array

# A usual QP needs one guess, a QP with active bounds two or three; the limit ends a cycle.
MOST_GUESSES = 8


def solve(H: Array, g: Array, lower: Array, upper: Array) -> tuple[Array, Array, int]:
    """Minimise 1/2 z' H z + g' z, H positive definite, (n, n), subject to lower <= z <= upper, possibly infinite.

    Returns: Solution, (n,); multipliers, (n,), positive at upper bounds; number of guesses, 0 for a failure, in which
        case the rest is meaningless.
    """
    if native.AVAILABLE:
        guesses, z, multipliers = native.within_bounds(np.ascontiguousarray(H), g, lower, upper, MOST_GUESSES)
        return z, multipliers, guesses
    return _solve(H, g, lower, upper)


def _solve(H: Array, g: Array, lower: Array, upper: Array) -> tuple[Array, Array, int]:
    z, multipliers = np.zeros(len(g)), np.zeros(len(g))
    # Start with the bounds at zero that the gradient pushes against, such as those of slacks.
    held = np.where((lower >= 0.0) & (g > 0.0), -1, np.where((upper <= 0.0) & (g < 0.0), 1, 0))
    for guess in range(1, MOST_GUESSES + 1):
        free = held == 0
        z[~free] = np.where(held < 0, lower, upper)[~free]
        try:
            U = np.linalg.cholesky(H[np.ix_(free, free)])
        except np.linalg.LinAlgError:
            break
        z[free] = np.linalg.solve(U.T, np.linalg.solve(U, -g[free] - H[np.ix_(free, ~free)] @ z[~free]))
        if not np.isfinite(z).all():
            break
        slope = H @ z + g
        multipliers = np.where(free, 0.0, -slope)
        stays = (lower == upper) | np.where(held < 0, slope >= 0.0, slope <= 0.0)
        crossed = np.where(z < lower, -1, np.where(z > upper, 1, 0))
        now = np.where(free, crossed, np.where(stays, held, 0))
        if (now == held).all():
            return z, multipliers, guess
        held = now
    return z, multipliers, 0
