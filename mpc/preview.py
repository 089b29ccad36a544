"""Preview of the reference: a feedforward of the inputs and a slope of the cost-to-go.

The regulator of `mpc.feedback` is the optimum for a reference at rest. A moving reference is a known disturbance of the
deviation from it; one backward recursion along the maneuver gives the optimum under that disturbance (Anderson and
Moore 1990, chapter 4; Tomizuka 1975), once per maneuver and team.
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import Array, frozen
from mpc.feedback import Regulator


@dataclass(frozen=True, slots=True, kw_only=True)
class Preview:
    """Effect of the reference on the optimum at instants 0..K-1 of a maneuver; the last one holds from then on.

    Attributes:
        feedforward: Added to the shared control law, (K, m).
        slope: Half the gradient of the cost-to-go where the deviation from the reference is zero, (K, n).
    """

    feedforward: Array
    slope: Array


def preview(regulator: Regulator, X_ref: Array, pull: Array) -> Preview:
    """Solve the tracking problem backwards from the reference at rest after the last instant.

    With xi the deviation from the reference, the regulator's problem becomes

        xi(k+1) = A xi(k) + B du(k) + d(k),    d(k) = A xi_ref(k) - xi_ref(k+1),
        stage cost xi' Q xi + 2 pull(k)' xi + du' R du,    cost-to-go xi' P xi + 2 p(k)' xi + constant,
        p(k) = A_closed' (p(k+1) + P d(k)) + pull(k),    du(k) = K xi(k) - (R + B' P B)^-1 B' (p(k+1) + P d(k)).

    Args:
        regulator: Of the team.
        X_ref: Reference states at the instants of the maneuver, (K, n); held after the last one.
        pull: Half the gradient of the stage cost where the deviation is zero, (K, n).
    Source: docs/equations.md (36b), (36c).
    """
    T, P, A_closed = regulator.T, regulator.P, regulator.A_closed
    # Relative to the last instant, which is at rest, so that the attitudes at hover are no deviation.
    reference, pulled = (X_ref - X_ref[-1]) @ T, pull @ T
    drift = np.zeros_like(reference)
    drift[:-1] = reference[:-1] @ regulator.A.T - reference[1:]
    pushed = drift @ P  # P is symmetric
    slope = np.zeros_like(reference)
    feedforward = np.zeros((len(X_ref), len(regulator.K)))
    p: Array = at_rest(regulator, pulled[-1])
    # Before an end at rest without pull all is zero: a long hover takes no time when the team changes.
    last = len(X_ref) - 1 if p.any() else int(np.flatnonzero(drift.any(axis=1) | pulled.any(axis=1)).max(initial=-1))
    for k in range(last, -1, -1):
        h = p + pushed[k]
        feedforward[k, regulator.controlled] = regulator.preview_gain @ h
        slope[k] = h @ A_closed + pulled[k]
        p = slope[k]
    slope = slope @ T.T
    frozen(feedforward, slope)
    return Preview(feedforward=feedforward, slope=slope)


def at_rest(regulator: Regulator, pulled: Array) -> Array:
    """Return the slope of the cost-to-go under a constant pull: the solution of p = A_closed' p + pulled.

    Directions without cost (headings) are neither pulled nor damped; the slope has no part along them. A_closed' maps
    the other directions into themselves, and there the solution is unique: the sum of all future pulls.

    Pull, half the gradient of the stage cost, and slope are in the regulator's coordinates, (r,) or (r, columns).
    """
    costly = np.linalg.svd(regulator.root @ regulator.T, full_matrices=False)[2]  # orthonormal basis, (rank, r)
    within = np.eye(len(costly)) - costly @ regulator.A_closed.T @ costly.T
    solution: Array = costly.T @ np.linalg.solve(within, costly @ pulled)
    return solution
