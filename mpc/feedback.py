"""The shared linear-quadratic regulator: the infinite-horizon optimum of the team's cost about hover.

Every agent computes the same gain and cost-to-go, decides its own corrections c to the shared control law
u = u_rest + K (x - x_ref) + feedforward + c, and takes the others' corrections as announced. Near the unconstrained
optimum the corrections are small, so little depends on the network.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from model import state
from model.arrays import Array, frozen, padded
from model.discretisation import zero_order_hold
from model.hover import Hover
from model.linearisation import Model
from model.motors import lagged
from model.state import input_indices
from mpc.cost import Cost

# Doublings of the Riccati recursion: 2^k steps after k of them. The slowest mode of a load on rods of a few metres
# decays within some thousand sampling periods.
_DOUBLINGS = 20
_CONVERGED = 1e-12
# Square root of the discount of the cost per sampling period, used only where the undiscounted cost is infinite;
# 1e-4 is a time constant of 500 s at 50 ms.
_DISCOUNT = 1.0 - 1e-4
# Largest growth rate of the closed loop, 1/s. Headings and the positions of UAVs without agents are constant (growth
# zero), a UAV that falls over has 2 1/s; growth by e in 50 s is within the error of the linearisation.
_GROWTH = 0.02
# Largest gain relative to sqrt(Q / R), the gain of a single integrator: 0.1 to 2 for teams that can be stabilised, 500
# and more for modes that inputs reach through rounding only.
_GAIN = 100.0
# Directions whose cost is below this share of the largest count as free (headings).
_RANK = 1e-12


class FeedbackError(ValueError):
    """No stabilising feedback exists or was found; the text says why."""


@dataclass(frozen=True, kw_only=True)
class FeedbackLaw:
    """The shared control law over one horizon.

    Attributes:
        K: Feedback gain, (m, n); with motor lag n counts the actual inputs.
        u_rest: Input that holds the reference state: hover, shifted by external forces, (m,).
        error: x0 - x_ref, x_ref shifted likewise, at steps 0..N_p-1, (N_p, n).
        feedforward: Response to the reference ahead, (N_p, m).
        c: Announced corrections of all UAVs, (N_p, m); the owned columns hold the previous ones, shifted.
    """

    K: Array
    u_rest: Array
    error: Array
    feedforward: Array
    c: Array

    @cached_property
    def uncorrected(self) -> Array:
        """Inputs with the state held at x0, without corrections, (N_p, m)."""
        return self.u_rest + self.error @ self.K.T + self.feedforward


@dataclass(frozen=True, slots=True, kw_only=True)
class Regulator:
    """The regulator of the team about hover, in coordinates xi = T' (x - x_hover) of the manifold.

    With motor lag the actual inputs are further states, and n counts them.

    Attributes:
        K: Feedback gain of all inputs, (m, n).
        P: Cost-to-go, xi' P xi, (r, r).
        root: Its square root, |root (x - x_hover)|^2 = xi' P xi, (rank of P, n).
        T: Orthonormal basis of the manifold's directions, (n, r).
        controlled: Positions in u of the inputs of UAVs with agents, (m_c,).
        A: State matrix without the feedback of the controlled inputs, (r, r).
        A_closed: State matrix with all feedback, (r, r).
        preview_gain: Controlled inputs per slope of the cost-to-go one step later, -(R + B' P B)^-1 B', (m_c, r).
    """

    K: Array
    P: Array
    root: Array
    T: Array
    controlled: npt.NDArray[np.intp]
    A: Array
    A_closed: Array
    preview_gain: Array


def regulator(
    model: Model,
    hover: Hover,
    cost: Cost,
    period_s: float,
    uncontrolled: Mapping[int, Array] | None = None,
    further: Array | None = None,
    off: Collection[int] = (),
    released: Collection[int] = (),
    motor_lag_s: float = 0.0,
) -> Regulator:
    """Return the linear-quadratic regulator of the team about hover.

    UAVs without an agent follow a control law of their own; the gain of the others is the optimum given that law.
    Directions off |e| = 1 and e . Omega = 0 can be neither reached nor left: the recursion has no coordinates for them.

    Args:
        model: The system as the controller knows it.
        hover: Its equilibrium.
        cost: Q on the outputs, R on all inputs.
        period_s: Sampling period, s.
        uncontrolled: Feedback from its own state, (4, 12), of each UAV without an agent, by its 0-based number.
        further: Further terms of the cost, (t, n): square roots of the weights times slopes at hover.
        off: UAVs without motors, 0-based; their attitudes are decoupled from all else and left out.
        released: UAVs no longer on their rods, 0-based; all their states are left out.
        motor_lag_s: Time constant of the motors, s; their actual inputs are further states if it is positive.
    Raises: FeedbackError: the recursion does not converge, or its feedback does not stabilise the team.
    Source: docs/equations.md (33)-(34), (45), (55).
    """
    linear = model.linearise(hover.x, hover.u)
    T = tangent(hover.x, off, released)
    if motor_lag_s > 0.0:
        linear, T = lagged(linear, hover.u, hover.u, motor_lag_s), with_motors(T, off)
    discrete = zero_order_hold(linear, period_s)
    K: Array = np.zeros((len(hover.u), len(T)))
    for uav, own in (uncontrolled or {}).items():
        K[state.input_slice(uav), state.uav_slice(uav)] = own
    controlled = np.setdiff1d(np.arange(len(hover.u)), input_indices(sorted(uncontrolled or {})))
    A, B = T.T @ (discrete.A + discrete.B @ K) @ T, T.T @ discrete.B[:, controlled]
    C, R = linear.C @ T, cost.R[controlled]
    weighted = C.T @ (cost.Q[:, None] * C)
    if further is not None:
        further = padded(further, len(T))
        weighted += T.T @ further.T @ further @ T
    try:
        P, discount = _riccati(A, B, weighted, R), 1.0
    except FeedbackError:
        if not uncontrolled:
            raise
        # Equal UAVs without agents can swing against each other undamped and out of reach of the other inputs: the
        # infinite sum of that cost is finite only with a discount.
        P, discount = _riccati(_DISCOUNT * A, _DISCOUNT * B, weighted, R), _DISCOUNT
    preview_gain = np.negative(np.linalg.solve(np.diag(R) / discount**2 + B.T @ P @ B, B.T), dtype=np.float64)
    K[controlled] = preview_gain @ P @ A @ T.T
    eigenvalues, vectors = np.linalg.eigh(P)
    kept = eigenvalues > _RANK * eigenvalues[-1]
    root = np.sqrt(eigenvalues[kept])[:, None] * vectors[:, kept].T @ T.T
    A_closed = A + B @ K[controlled] @ T
    # The recursion may converge although no input reaches an unstable mode.
    expected = "expected a team that linear feedback can stabilise about hover"
    largest = float(np.abs(np.linalg.eigvals(A_closed)).max())
    if not largest < math.exp(_GROWTH * period_s):
        raise FeedbackError(f"{expected}, got a closed loop whose largest eigenvalue is {largest:.3g}")
    gain = float(np.abs(K[:, : len(hover.x)]).max()) / math.sqrt(cost.Q.max() / cost.R.min())
    if not gain < _GAIN:
        raise FeedbackError(f"{expected}, got a gain {gain:.3g} times that of an integrator")
    frozen(K, P, root, T, controlled, A, A_closed, preview_gain)
    return Regulator(K=K, P=P, root=root, T=T, controlled=controlled, A=A, A_closed=A_closed, preview_gain=preview_gain)


def _riccati(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Return the least positive semidefinite solution of the discrete algebraic Riccati equation, by doubling.

    H after k doublings is the Riccati recursion from zero after 2^k steps, so modes without cost (a UAV's heading) stay
    without cost instead of making the equation unsolvable.
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
    expected = "expected a team that linear feedback can stabilise about hover"
    raise FeedbackError(f"{expected}, got a Riccati recursion that has not converged after 2^{_DOUBLINGS} steps")


def tangent(x: Array, off: Collection[int] = (), released: Collection[int] = ()) -> Array:
    """Return an orthonormal basis of the directions the state can take at x, (n, n - 2 N).

    Args:
        x: State, (n,).
        off: UAVs, 0-based, whose attitudes and rates are left out: 6 columns less for each.
        released: UAVs, 0-based, all of whose states are left out: 10 columns less.
    """
    blocks = [np.eye(state.PAYLOAD)]
    for e in state.StateView(x).e_P:
        across = np.linalg.svd(e[None, :])[2][1:].T  # two unit vectors across the rod
        blocks += [across, across, np.eye(state.PER_UAV - 6)]
    basis = np.zeros((len(x), sum(block.shape[1] for block in blocks)))
    row = column = 0
    for block in blocks:
        basis[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    out = np.zeros(len(x), dtype=bool)
    for uav in off:
        out[state.uav_slice(uav)][state.THETA.start :] = True
    for uav in released:
        out[state.uav_slice(uav)] = True
    kept: Array = basis[:, ~basis[out].any(axis=0)]
    return kept


def with_motors(T: Array, off: Collection[int]) -> Array:
    """Return a basis of directions of states and actual inputs from that of states, (n, r): (n + m, r + m).

    The inputs of UAVs without motors, 0-based, are left out: 4 columns less for each.
    """
    n = len(T)
    m = (n - state.PAYLOAD) // state.PER_UAV * state.INPUTS
    kept = np.setdiff1d(np.arange(m), input_indices(sorted(off)))
    basis = np.zeros((n + m, T.shape[1] + len(kept)))
    basis[:n, : T.shape[1]] = T
    basis[n + kept, T.shape[1] + np.arange(len(kept))] = 1.0
    return basis
