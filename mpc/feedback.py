"""The stabilising law all agents share, and what it needs: u = u_rest + K (x - x_ref) + c.

K is the infinite-horizon optimum of the team's cost at hover, the same for every agent. Each agent decides
its own corrections c and takes the others' as announced; near the unconstrained optimum they are small,
so little depends on the network.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from model import state
from model.arrays import Array
from model.discretisation import zero_order_hold
from model.hover import Hover
from model.linearisation import Model
from model.state import input_indices
from mpc.cost import Cost

# Doublings of the Riccati recursion: 2^k steps after k of them. The slowest mode of a load on rods of a few
# metres forgets within some thousand sampling periods.
_DOUBLINGS = 20
_CONVERGED = 1e-12


class FeedbackError(ValueError):
    """No stabilising feedback was found; the text says how far the recursion came."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TeamLaw:
    """The shared law over one horizon.

    Attributes:
        K: Feedback gain, (m, n).
        u_rest: Input that holds the reference state: at hover, or as moved by external forces, (m,).
        error: x0 - x_ref, x_ref moved likewise, at steps 0..N_p-1, (N_p, n).
        c: Announced corrections of all UAVs, (N_p, m); the owned columns hold the previous ones, shifted.
    """

    K: Array
    u_rest: Array
    error: Array
    c: Array

    def inputs(self, columns: np.ndarray) -> Array:
        """Inputs of the given columns while the state stays at x0, (N_p, columns)."""
        inputs: Array = self.u_rest[columns] + self.error @ self.K[columns].T + self.c[:, columns]
        return inputs


def team_gain(
    model: Model,
    hover: Hover,
    cost: Cost,
    period_s: float,
    alone: Mapping[int, Array] | None = None,
    further: Array | None = None,
) -> Array:
    """Feedback gain of the linear-quadratic regulator for the whole team about hover.

    UAVs that nobody decides for any more follow a law of their own; the others' gain is the optimum given that.

    Rod directions move on a sphere: the directions off |e| = 1 and e . Omega = 0 can be neither reached nor
    left, so the recursion runs in coordinates without them.

    Args:
        model: The system as the controller knows it.
        hover: Its equilibrium.
        cost: Q on the outputs, R on all inputs.
        period_s: Sampling period, s.
        alone: Feedback from its own state, (4, 12), of each UAV without an agent, by its 0-based number.
        further: What else has a price besides the outputs, (t, n): square roots of the weights times slopes at hover.
    Returns: K with u = u_hover + K (x - x_ref), (m, n).
    Raises: FeedbackError: the recursion does not converge.
    Source: docs/equations.md (33)-(34), (45).
    """
    linear = model.linearise(hover.x, hover.u)
    discrete = zero_order_hold(linear, period_s)
    K: Array = np.zeros((len(hover.u), len(hover.x)))
    for uav, own in (alone or {}).items():
        K[state.input_slice(uav), state.uav_slice(uav)] = own
    led = np.setdiff1d(np.arange(len(hover.u)), input_indices(sorted(alone or {})))
    T = tangent(hover.x)
    A, B = T.T @ (discrete.A + discrete.B @ K) @ T, T.T @ discrete.B[:, led]
    C, R = linear.C @ T, cost.R[led]
    priced = C.T @ (cost.Q[:, None] * C)
    if further is not None:
        priced += T.T @ further.T @ further @ T
    P = _riccati(A, B, priced, R)
    K[led] = -np.linalg.solve(np.diag(R) + B.T @ P @ B, B.T @ P @ A) @ T.T
    K.setflags(write=False)
    return K


def _riccati(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Least positive semidefinite solution of the discrete algebraic Riccati equation, by doubling.

    H after k doublings is the Riccati recursion from zero after 2^k steps, so modes that cost nothing (a UAV's
    heading) stay without cost instead of making the equation unsolvable.
    """
    identity = np.eye(len(A))
    G = (B / R) @ B.T
    H = Q
    for _ in range(_DOUBLINGS):
        inverse = np.linalg.solve(identity + G @ H, np.concatenate([A, G], axis=1))
        VA, VG = inverse[:, : len(A)], inverse[:, len(A) :]
        step = A.T @ H @ VA
        G, H, A = G + A @ VG @ A.T, H + (step + step.T) / 2.0, A @ VA
        if np.abs(step).max() <= _CONVERGED * np.abs(H).max():
            return H
    expected = "expected a team that a linear law can stabilise about hover"
    raise FeedbackError(f"{expected}, got a Riccati recursion that has not converged after 2^{_DOUBLINGS} steps")


def tangent(x: Array) -> Array:
    """Orthonormal basis of the directions the state can take at x, (n, n - 2 N)."""
    blocks = [np.eye(state.PAYLOAD)]
    for e in state.StateView(x).e_P:
        across = np.linalg.svd(e[None, :])[2][1:].T  # two unit vectors across the rod
        blocks += [across, across, np.eye(state.PER_UAV - 6)]
    basis = np.zeros((len(x), sum(block.shape[1] for block in blocks)))
    row = column = 0
    for block in blocks:
        basis[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    return basis
