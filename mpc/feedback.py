"""The regulator that all agents share: the infinite-horizon optimum of the team's cost about hover.

Every agent computes the same gain and the same cost-to-go. Each agent decides its own corrections to the control law
u = u_rest + K (x - x_ref) + feedforward + c and takes the others' as announced; near the unconstrained optimum the
corrections are small, so little depends on the network.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

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
# Of the cost per sampling period, squared, where without it the cost is infinite: 1e-4 forgets in 500 s at 50 ms.
_DISCOUNT = 1.0 - 1e-4
# Headings and the places of UAVs without agents stay as they are: growth of zero. A UAV that falls over has 2 1/s; of
# what the linearisation leaves undecided, growth by e in 50 s is slow enough. 1/s.
_GROWTH = 0.02
# Largest gain over sqrt(Q / R), what a single integrator would get: 0.1 to 2 for teams that can be stabilised. Modes
# that inputs reach through rounding alone ask for 500 and more.
_GAIN = 100.0
# Directions whose cost is below this share of the largest cost nothing (headings).
_RANK = 1e-12


class FeedbackError(ValueError):
    """No stabilising feedback was found; the text says how far the recursion came."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FeedbackLaw:
    """The shared control law over one horizon.

    Attributes:
        K: Feedback gain, (m, n).
        u_rest: Input that holds the reference state: at hover, or as moved by external forces, (m,).
        error: x0 - x_ref, x_ref moved likewise, at steps 0..N_p-1, (N_p, n).
        feedforward: What the reference ahead asks for in advance, (N_p, m).
        c: Announced corrections of all UAVs, (N_p, m); the owned columns hold the previous ones, shifted.
    """

    K: Array
    u_rest: Array
    error: Array
    feedforward: Array
    c: Array

    def inputs(self, columns: npt.NDArray[np.intp]) -> Array:
        """Inputs of the given columns while the state stays at x0, (N_p, columns)."""
        return self.uncorrected(columns) + self.c[:, columns]

    def uncorrected(self, columns: npt.NDArray[np.intp]) -> Array:
        """The same without corrections, (N_p, columns)."""
        held: Array = self.u_rest[columns] + self.error @ self.K[columns].T + self.feedforward[:, columns]
        return held


@dataclass(frozen=True, slots=True, kw_only=True)
class Regulator:
    """Linear-quadratic regulator of the team about hover, in coordinates xi = T' (x - x_hover) of the manifold.

    Attributes:
        K: Feedback gain of all inputs, (m, n).
        P: Cost-to-go, xi' P xi, (r, r).
        root: Its square root, |root (x - x_hover)|^2 = xi' P xi, (rank of P, n).
        T: Orthonormal basis of the manifold's directions, (n, r).
        A: State matrix without the led UAVs' feedback, (r, r).
        closed: State matrix with all feedback, (r, r).
        ahead: Inputs of the led UAVs per slope of the cost-to-go one step later, -(R + B' P B)^-1 B', (m_led, r).
        led: Inputs of the UAVs that have agents, (m_led,).
    """

    K: Array
    P: Array
    root: Array
    T: Array
    A: Array
    closed: Array
    ahead: Array
    led: npt.NDArray[np.intp]


def regulator(
    model: Model,
    hover: Hover,
    cost: Cost,
    period_s: float,
    uncontrolled: Mapping[int, Array] | None = None,
    further: Array | None = None,
    off: Collection[int] = (),
    released: Collection[int] = (),
) -> Regulator:
    """Linear-quadratic regulator for the whole team about hover.

    UAVs without an agent follow a control law of their own; the others' gain is the optimum given that.

    Rod directions move on a sphere: the directions off |e| = 1 and e . Omega = 0 can be neither reached nor
    left, so the recursion runs in coordinates without them.

    Args:
        model: The system as the controller knows it.
        hover: Its equilibrium.
        cost: Q on the outputs, R on all inputs.
        period_s: Sampling period, s.
        uncontrolled: Feedback from its own state, (4, 12), of each UAV without an agent, by its 0-based number.
        further: Further terms of the cost, (t, n): square roots of the weights times slopes at hover.
        off: UAVs without motors, 0-based: nothing moves their attitude, and it moves nothing.
        released: UAVs that are no longer on their rods, 0-based: the same holds for all their states.
    Returns: Gain, cost-to-go and what a preview of the reference needs.
    Raises: FeedbackError: the recursion does not converge, or its feedback does not stabilise the team.
    Source: docs/equations.md (33)-(34), (45).
    """
    linear = model.linearise(hover.x, hover.u)
    discrete = zero_order_hold(linear, period_s)
    K: Array = np.zeros((len(hover.u), len(hover.x)))
    for uav, own in (uncontrolled or {}).items():
        K[state.input_slice(uav), state.uav_slice(uav)] = own
    led = np.setdiff1d(np.arange(len(hover.u)), input_indices(sorted(uncontrolled or {})))
    T = tangent(hover.x, off, released)
    A, B = T.T @ (discrete.A + discrete.B @ K) @ T, T.T @ discrete.B[:, led]
    C, R = linear.C @ T, cost.R[led]
    weighted = C.T @ (cost.Q[:, None] * C)
    if further is not None:
        weighted += T.T @ further.T @ further @ T
    try:
        P, discount = _riccati(A, B, weighted, R), 1.0
    except FeedbackError:
        if not uncontrolled:
            raise
        # Equal UAVs without agents swing against each other for ever, which no other UAV can reach and which has a
        # cost: the infinite sum is finite only if the far future counts less.
        P, discount = _riccati(_DISCOUNT * A, _DISCOUNT * B, weighted, R), _DISCOUNT
    ahead = np.negative(np.linalg.solve(np.diag(R) / discount**2 + B.T @ P @ B, B.T), dtype=np.float64)
    K[led] = ahead @ P @ A @ T.T
    eigenvalues, vectors = np.linalg.eigh(P)
    kept = eigenvalues > _RANK * eigenvalues[-1]
    root = np.sqrt(eigenvalues[kept])[:, None] * vectors[:, kept].T @ T.T
    closed = A + B @ K[led] @ T
    # Where no input reaches an unstable mode the recursion may still seem to end.
    expected = "expected a team that a linear law can stabilise about hover"
    largest = float(np.abs(np.linalg.eigvals(closed)).max())
    if not largest < math.exp(_GROWTH * period_s):
        raise FeedbackError(f"{expected}, got a closed loop whose largest eigenvalue is {largest:.3g}")
    gain = float(np.abs(K).max()) / math.sqrt(cost.Q.max() / cost.R.min())
    if not gain < _GAIN:
        raise FeedbackError(f"{expected}, got a gain {gain:.3g} times that of an integrator")
    for array in (K, P, root, T, A, closed, ahead, led):
        array.setflags(write=False)
    return Regulator(K=K, P=P, root=root, T=T, A=A, closed=closed, ahead=ahead, led=led)


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


def tangent(x: Array, off: Collection[int] = (), released: Collection[int] = ()) -> Array:
    """Orthonormal basis of the directions the state can take at x, (n, n - 2 N).

    Args:
        x: State, (n,).
        off: UAVs, 0-based, whose attitudes and their rates stay out: 6 columns less for each of them.
        released: UAVs, 0-based, all of whose states stay out: 10 columns less.
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
