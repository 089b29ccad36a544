"""A primal-dual active-set method for programs with bounds alone.

Guess which bounds hold; solve the equations that are left; let go of bounds that are pulled at, hold those that are
crossed; again, until the guess explains itself (Hintermueller, Ito, Kunisch 2003, a semismooth Newton method). One
factorisation a guess, and most programs of a flight need one. It may go in circles: then it has failed, and says so.
"""

import numpy as np

from model import native
from model.arrays import Array

# The usual program needs one guess, one with bounds that hold two or three; a circle is caught here.
MOST_GUESSES = 8


def solve(H: Array, g: Array, lower: Array, upper: Array) -> tuple[Array, Array, int]:
    """Minimise 1/2 z' H z + g' z subject to lower <= z <= upper.

    Args:
        H: Positive definite, (n, n).
        g: (n,).
        lower: (n,), -inf where there is none.
        upper: (n,), inf where there is none.
    Returns: The answer, (n,); its multipliers, (n,), positive at upper bounds; how many guesses it took, 0 when it
        failed and the rest means nothing.
    """
    if native.AVAILABLE:
        guesses, z, multipliers = native.within_bounds(np.ascontiguousarray(H), g, lower, upper, MOST_GUESSES)
        return z, multipliers, guesses
    return _solve(H, g, lower, upper)


def _solve(H: Array, g: Array, lower: Array, upper: Array) -> tuple[Array, Array, int]:
    z, multipliers = np.zeros(len(g)), np.zeros(len(g))
    # Whoever is pulled at a bound that zero is at stays there: a slack, say.
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
