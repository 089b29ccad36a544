"""Preview of the reference: the optimal answer to what it does ahead, about hover.

Source: docs/equations.md (36b), (36c); Anderson and Moore 1990, chapter 4; Tomizuka 1975.
"""

from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array, frozen
from transport.mpc.law.infinite_horizon_lqr import Regulator


@dataclass(frozen=True, kw_only=True)
class Preview:
    """Effect of the reference on the optimum at instants 0..K-1 from `first` on.

    The last one holds from then on.
    """

    feedforward: Array  # added to the shared control law, (K, m)
    # Half the gradient of the cost-to-go where the deviation from the reference is zero, (K, n).
    slope: Array
    first: int = 0  # number of the first instant


def preview(
    regulator: Regulator,
    X_ref: Array,
    pull: Array,
    on_reference: Array | None = None,
    first: int = 0,
) -> Preview:
    """Solve the tracking problem backwards from the reference at rest after the last instant.

        d(k) = A xi_ref(k) - xi_ref(k+1) + B_u v(k)
        p(k) = A_closed' (p(k+1) + P d(k)) + q(k),   c_ff(k) = -(R + B'PB)^-1 B' (p(k+1) + P d(k))

    X_ref are states from the `first` instant on, (K, n); pull is half the slope of the cost there,
    q = T' pull, (K, n); v are the inputs of UAVs without an agent on the reference, from those at
    hover, (K, m_u), which are known as well. None: zero, they follow the reference.
    Source: docs/equations.md (36b), (36c), (45a).
    """
    T = regulator.T
    # Relative to the last instant, which is at rest, so that the attitudes at hover are no
    # deviation.
    xi_ref = (X_ref - X_ref[-1]) @ T
    q = pull @ T
    d = np.zeros_like(xi_ref)
    d[:-1] = xi_ref[:-1] @ regulator.A.T - xi_ref[1:]
    if on_reference is not None:
        d += on_reference @ regulator.B_uncontrolled.T
    Pd = d @ regulator.P  # P is symmetric

    slope = np.zeros_like(xi_ref)
    feedforward = np.zeros((len(X_ref), len(regulator.K)))
    if on_reference is not None:
        feedforward[:, regulator.uncontrolled] = on_reference
    p: Array = at_rest(regulator, q[-1])

    # Before an end at rest without pull all is zero: a long hover takes no time when the team
    # changes.
    last = len(X_ref) - 1
    if not p.any():
        moving = np.flatnonzero(d.any(axis=1) | q.any(axis=1))
        last = int(moving.max(initial=-1))
    for k in range(last, -1, -1):
        h = p + Pd[k]
        feedforward[k, regulator.controlled] = regulator.preview_gain @ h
        slope[k] = h @ regulator.A_closed + q[k]
        p = slope[k]

    slope = slope @ T.T
    frozen(feedforward, slope)
    return Preview(feedforward=feedforward, slope=slope, first=first)


def only_known(regulator: Regulator, on_reference: Array, first: int) -> Preview:
    """Return the inputs v of UAVs without an agent, (K, m_u), to which the others do not answer.

    Without preview the team's law still predicts what these UAVs do. Source: docs/equations.md (45a).
    """
    m, n = regulator.K.shape
    feedforward = np.zeros((len(on_reference), m))
    feedforward[:, regulator.uncontrolled] = on_reference
    slope = np.zeros((len(on_reference), n))
    frozen(feedforward, slope)
    return Preview(feedforward=feedforward, slope=slope, first=first)


def at_rest(regulator: Regulator, q: Array) -> Array:
    """Return the slope of the cost-to-go under a constant pull, (r, ..): p = A_closed' p + q.

    Zero along headings, which have no cost: solved in the directions that have one.
    """
    # Orthonormal basis of these directions, (rank, r).
    costly = np.linalg.svd(regulator.root @ regulator.T, full_matrices=False)[2]
    I_minus_A = np.eye(len(costly)) - costly @ regulator.A_closed.T @ costly.T
    return np.asarray(costly.T @ np.linalg.solve(I_minus_A, costly @ q))
