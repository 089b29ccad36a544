"""The shared linear-quadratic regulator.

The infinite-horizon optimum of the team's cost about hover.

Every agent decides its own corrections c to the shared control law u = u_rest + K (x - x_ref) +
feedforward + c.
Preview: Anderson and Moore 1990, chapter 4; Tomizuka 1975. Target, offset-free MPC: Pannocchia,
    Rawlings 2003.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from transport.model import state
from transport.model.arrays import Array, frozen, padded
from transport.model.discretisation import zero_order_hold
from transport.model.hover import Hover
from transport.model.linearisation import Model
from transport.model.motors import lagged
from transport.model.state import input_indices
from transport.mpc.cost import Cost

_DOUBLINGS = 20  # of the Riccati recursion: the slowest modes decay within some thousand periods
_CONVERGED = 1e-12
_DISCOUNT = 1.0 - 1e-4  # root of that of the cost per sampling period, where it is infinite without
_GROWTH = (
    0.02  # largest of the closed loop, 1/s: headings have zero, a UAV that falls over has 2 1/s
)
_GAIN = 100.0  # largest, relative to sqrt(Q / R): 0.1 to 2 for most teams, 500 where rounding alone reaches a mode
_RANK = 1e-12  # directions whose cost is below this share of the largest count as free (headings)
_EFFECT = 1e-9  # directions that change a quantity of the target by less, relative to the most, have no effect on it
_EXPECTED = "expected a team that linear feedback can stabilise about hover"


class FeedbackError(ValueError):
    """No stabilising feedback exists or was found; the text says why."""


@dataclass(frozen=True, kw_only=True)
class FeedbackLaw:
    """The shared control law over one horizon."""

    K: Array  # feedback gain, (m, n), or along a reference of each step, (N_p, m, n); n includes known motors
    u_rest: Array  # input that holds the reference state: hover, shifted by external forces, (m,), or of each step
    error: Array  # x0 - x_ref, x_ref shifted likewise, at steps 0..N_p-1, (N_p, n)
    feedforward: Array  # response to the reference ahead, (N_p, m)
    c: Array  # announced corrections of all UAVs, (N_p, m); the owned columns hold the previous ones, shifted
    along: "Sequence[Gains] | None" = None  # along a reference; None about hover

    @cached_property
    def uncorrected(self) -> Array:
        """Inputs with the state held at x0, without corrections, (N_p, m)."""
        if self.along is not None:
            return np.asarray(
                self.u_rest + np.einsum("kmn,kn->km", self.K, self.error) + self.feedforward
            )
        return self.u_rest + self.error @ self.K.T + self.feedforward


@dataclass(frozen=True, slots=True, kw_only=True)
class Gains:
    """The regulator at an instant of a reference, and the difference equation of the team about it."""

    K: Array  # feedback gain, (m, n)
    feedforward: Array  # response to the difference between the reference and the model's step along it, (m,)
    M: Array  # weight of the corrections, (m, m)
    A_closed: Array  # state matrix with all feedback, (n, n)
    B: Array  # input matrix, (n, m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Regulator:
    """The regulator about hover, in coordinates xi = T' (x - x_hover).

    With motor lag n counts the actual inputs.
    """

    K: Array  # feedback gain of all inputs, (m, n)
    P: Array  # cost-to-go, xi' P xi, (r, r)
    root: Array  # its square root, |root (x - x_hover)|^2 = xi' P xi, (rank of P, n)
    T: Array  # orthonormal basis of the manifold's directions, (n, r)
    controlled: npt.NDArray[np.intp]  # positions in u of the inputs of UAVs with agents, (m_c,)
    A: Array  # state matrix without the feedback of the controlled inputs, (r, r)
    A_closed: Array  # state matrix with all feedback, (r, r)
    preview_gain: Array  # controlled inputs per slope of the cost-to-go one step later, -(R + B' P B)^-1 B', (m_c, r)


def regulator(
    model: Model, hover: Hover, cost: Cost, period_s: float, uncontrolled: Mapping[int, Array] | None = None,
    further: Array | None = None, off: Collection[int] = (), released: Collection[int] = (), motor_lag_s: float = 0.0,
) -> Regulator:  # fmt: skip
    """Return the linear-quadratic regulator of the team about hover, with motor lag of [x, a].

    (33)-(34), (45), (55).

    UAVs without an agent, by 0-based numbers, follow a feedback of their own, (4, n). Further terms
    of the cost are roots of weights times slopes at hover, (t, n). Raises: FeedbackError: no
    feedback, or none that is stable.
    """
    linear = model.linearise(hover.x, hover.u)
    T = tangent(hover.x, off, released, motors=motor_lag_s > 0.0)
    if motor_lag_s > 0.0:
        linear = lagged(linear, hover.u, hover.u, motor_lag_s, model.system.commands_rates)
    discrete = zero_order_hold(linear, period_s)
    K: Array = np.zeros((len(hover.u), len(T)))
    for uav, own in (uncontrolled or {}).items():
        K[state.input_slice(uav), : own.shape[1]] = own
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
        # UAVs without agents can swing against each other undamped, out of reach: their cost is
        # infinite without it.
        P, discount = _riccati(_DISCOUNT * A, _DISCOUNT * B, weighted, R), _DISCOUNT
    preview_gain = np.negative(
        np.linalg.solve(np.diag(R) / discount**2 + B.T @ P @ B, B.T), dtype=np.float64
    )
    K[controlled] = preview_gain @ P @ A @ T.T
    eigenvalues, vectors = np.linalg.eigh(P)
    kept = eigenvalues > _RANK * eigenvalues[-1]
    root = np.sqrt(eigenvalues[kept])[:, None] * vectors[:, kept].T @ T.T
    A_closed = A + B @ K[controlled] @ T
    # The recursion may converge although no input reaches an unstable mode.
    largest = float(np.abs(np.linalg.eigvals(A_closed)).max())
    if not largest < math.exp(_GROWTH * period_s):
        raise FeedbackError(
            f"{_EXPECTED}, got a closed loop whose largest eigenvalue is {largest:.3g}"
        )
    gain = float(np.abs(K[:, : len(hover.x)]).max()) / math.sqrt(cost.Q.max() / cost.R.min())
    if not gain < _GAIN:
        raise FeedbackError(f"{_EXPECTED}, got a gain {gain:.3g} times that of an integrator")
    frozen(K, P, root, T, controlled, A, A_closed, preview_gain)
    return Regulator(
        K=K,
        P=P,
        root=root,
        T=T,
        controlled=controlled,
        A=A,
        A_closed=A_closed,
        preview_gain=preview_gain,
    )


def _riccati(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Return the least positive semidefinite solution of the discrete algebraic Riccati equation, by doubling."""
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
    raise FeedbackError(
        f"{_EXPECTED}, got a Riccati recursion that has not converged after 2^{_DOUBLINGS} steps"
    )


def tangent(
    x: Array, off: Collection[int] = (), released: Collection[int] = (), motors: bool = False
) -> Array:
    """Return an orthonormal basis of directions of x, (n, n - 2 N), or [x, a], but of UAVs off and released."""
    uavs, out = state.StateView(x).e_P, np.zeros(len(x), dtype=bool)
    basis, each = np.zeros((len(x), len(x) - 2 * len(uavs))), state.PER_UAV - 2
    basis[: state.PAYLOAD, : state.PAYLOAD] = np.eye(state.PAYLOAD)
    for i, e in enumerate(uavs):
        own = basis[state.uav_slice(i), state.PAYLOAD + each * i : state.PAYLOAD + each * (i + 1)]
        own[state.E, :2] = own[state.ROD_RATE, 2:4] = np.linalg.svd(e[None, :])[2][
            1:
        ].T  # unit vectors across the rod
        own[6:, 4:] = np.eye(6)
        out[state.uav_slice(i)][0 if i in released else state.THETA.start :] = (
            i in off or i in released
        )
    basis = basis[:, ~basis[out].any(axis=0)]
    if motors:
        m, (n, r), states = state.INPUTS * len(uavs), basis.shape, basis
        kept = np.setdiff1d(np.arange(m), input_indices(sorted(off)))
        basis = np.zeros((n + m, r + len(kept)))
        basis[:n, :r], basis[n + kept, r + np.arange(len(kept))] = states, 1.0
    return np.asarray(basis)


@dataclass(frozen=True, slots=True, kw_only=True)
class Preview:
    """Effect of the reference on the optimum at instants 0..K-1 from `first` on.

    The last one holds from then on.
    """

    feedforward: Array  # added to the shared control law, (K, m)
    slope: Array  # half the gradient of the cost-to-go where the deviation from the reference is zero, (K, n)
    first: int = 0  # number of the first instant


def preview(regulator: Regulator, X_ref: Array, pull: Array, first: int = 0) -> Preview:
    """Solve the tracking problem backwards from the reference at rest after the last instant.

    (36b), (36c).

        d(k) = A xi_ref(k) - xi_ref(k+1),   p(k) = A_closed' (p(k+1) + P d(k)) + pull(k)

    X_ref are states from the `first` instant on, (K, n), pull half the slope of the cost there, (K,
    n).
    """
    T, P, A_closed = regulator.T, regulator.P, regulator.A_closed
    # Relative to the last instant, which is at rest, so that the attitudes at hover are no
    # deviation.
    reference, pulled = (X_ref - X_ref[-1]) @ T, pull @ T
    drift = np.zeros_like(reference)
    drift[:-1] = reference[:-1] @ regulator.A.T - reference[1:]
    pushed = drift @ P  # P is symmetric
    slope = np.zeros_like(reference)
    feedforward = np.zeros((len(X_ref), len(regulator.K)))
    p: Array = at_rest(regulator, pulled[-1])
    # Before an end at rest without pull all is zero: a long hover takes no time when the team
    # changes.
    last = (
        len(X_ref) - 1
        if p.any()
        else int(np.flatnonzero(drift.any(axis=1) | pulled.any(axis=1)).max(initial=-1))
    )
    for k in range(last, -1, -1):
        h = p + pushed[k]
        feedforward[k, regulator.controlled] = regulator.preview_gain @ h
        slope[k] = h @ A_closed + pulled[k]
        p = slope[k]
    slope = slope @ T.T
    frozen(feedforward, slope)
    return Preview(feedforward=feedforward, slope=slope, first=first)


def at_rest(regulator: Regulator, pulled: Array) -> Array:
    """Return the slope of the cost-to-go under a constant pull, (r, ..).

    P = A_closed' p + pulled, 0 along headings.
    """
    costly = np.linalg.svd(regulator.root @ regulator.T, full_matrices=False)[
        2
    ]  # orthonormal basis, (rank, r)
    within = np.eye(len(costly)) - costly @ regulator.A_closed.T @ costly.T
    return np.asarray(costly.T @ np.linalg.solve(within, costly @ pulled))


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """The deviation from hover of the steady state under external forces, linear in them."""

    M_x: Array  # state per newton, (n, 3 + 3 N), SI
    M_u: Array  # input per newton, (m, 3 + 3 N), SI


def target(
    model: Model, hover: Hover, cost: Cost, uncontrolled: Mapping[int, Array] | None = None, off: Collection[int] = (),
    released: Collection[int] = (),
) -> Target:  # fmt: skip
    """Return the steady state with least output error, then least input effort, the rest as at hover: (40).

    UAVs, 0-based, that are uncontrolled follow gains of their own, (4, n); others are off or
    released.
    """
    linear = model.linearise(hover.x, hover.u)
    E = model.force_effect(hover.x, hover.u)
    T = tangent(hover.x, off, released)
    states, inputs = T.shape[1], len(hover.u)
    at_rest = [(T.T @ np.hstack([linear.A_c @ T, linear.B_c]), -T.T @ E)]
    for uav, K in (uncontrolled or {}).items():
        own_law = np.hstack([-K @ T, np.eye(inputs)[state.input_slice(uav)]])
        at_rest.append((own_law, np.zeros((len(K), E.shape[1]))))
    rest, pushed = (np.vstack(rows) for rows in zip(*at_rest, strict=True))
    error = np.hstack([np.sqrt(cost.Q)[:, None] * (linear.C @ T), np.zeros((len(cost.Q), inputs))])
    effort = np.hstack([np.zeros((inputs, states)), np.diag(np.sqrt(cost.R))])
    z = np.zeros((states + inputs, E.shape[1]))
    free = np.eye(states + inputs)  # directions in which z may still move
    for G, h in ((rest, pushed), (error, 0.0), (effort, 0.0)):
        U, s, Vt = np.linalg.svd(G @ free)
        rank = int((s > _EFFECT * np.linalg.norm(G)).sum())
        z += free @ Vt[:rank].T @ ((U[:, :rank].T @ (h - G @ z)) / s[:rank, None])
        free = free @ Vt[rank:].T
    M_x, M_u = T @ z[:states], z[states:]
    frozen(M_x, M_u)
    return Target(M_x=M_x, M_u=M_u)
