"""The team's linear-quadratic regulator about hover: the infinite-horizon optimum of its cost."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from transport.model import state
from transport.model.arrays import Array, frozen, padded
from transport.model.linear.discretisation import Discrete, zero_order_hold
from transport.model.linear.linearisation import Linearisation, Model
from transport.model.linear.motor_lag import with_lag
from transport.model.physics.hover import Hover
from transport.model.state import input_indices
from transport.mpc.law.tangent import tangent
from transport.mpc.program.feedback_law import FeedbackError
from transport.mpc.program.stage_cost import Cost

_DOUBLINGS = 20  # of the Riccati recursion: the slowest modes decay within some thousand periods
_CONVERGED = 1e-12  # last increment of the recursion, relative to its sum
_DISCOUNT = 1.0 - 1e-4  # root of that of the cost per sampling period, where it is infinite without
# Largest growth of the closed loop, 1/s: headings have zero, a UAV that falls over has 2 1/s.
_GROWTH = 0.02
# Largest gain, relative to sqrt(Q / R): 0.1 to 2 for most teams, 500 where rounding alone reaches a
# mode.
_GAIN = 100.0
# Directions whose cost is below this share of the largest count as free (headings).
_RANK = 1e-12
_EXPECTED = "expected a team that linear feedback can stabilise about hover"


class TeamFailures(NamedTuple):
    """UAVs, 0-based, without an agent, without motors, and of these the released ones."""

    gone: frozenset[int] = frozenset()
    off: frozenset[int] = frozenset()
    released: frozenset[int] = frozenset()


@dataclass(frozen=True, kw_only=True, eq=False)
class HoveringTeam:
    """A team about its hover, as the regulator sees it."""

    model: Model
    hover: Hover
    cost: Cost
    team: TeamFailures = field(default_factory=TeamFailures)
    # Feedback of UAVs without an agent, (4, n), by 0-based numbers.
    uncontrolled: Mapping[int, Array] = field(default_factory=dict)


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
    uncontrolled: npt.NDArray[np.intp]  # those of UAVs without an agent, (m_u,)
    A: Array  # state matrix without any feedback, (r, r)
    B_uncontrolled: Array  # effect of the uncontrolled inputs, (r, m_u)
    A_closed: Array  # state matrix with all feedback, (r, r)
    # Controlled inputs per slope of the cost-to-go one step later, -M^-1 B', (m_c, r).
    #   M = R + B'PB; with the discount of (45) R is divided by its square.
    preview_gain: Array


def regulator(
    hovering: HoveringTeam, period_s: float, motor_lag_s: float = 0.0, further: Array | None = None
) -> Regulator:
    """Return the linear-quadratic regulator of a team about hover, with motor lag of [x, a].

    In coordinates xi of the manifold, with the feedback of UAVs without agents in A,

        P = A'P (I + B R^-1 B'P)^-1 A + C'QC,   K = -(R + B'PB)^-1 B'P A T'.

    Further terms of the cost are roots of weights times slopes at hover, (t, n).
    Raises: FeedbackError: no feedback, or none that is stable.
    Source: docs/equations.md (33), (34), (45), (55).
    """
    try:
        return _regulator(hovering, period_s, motor_lag_s, further)
    except np.linalg.LinAlgError as error:
        got = "a Riccati equation beyond the range of numbers: weights or slopes are too large"
        raise FeedbackError(f"{_EXPECTED}, got {got}") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class _Problem:
    """The regulator's problem in coordinates xi of the manifold, UAVs without agents in A."""

    T: Array  # basis of the manifold's directions, (n, r)
    K_fixed: Array  # feedback of UAVs without agents, (m, n)
    controlled: npt.NDArray[np.intp]  # positions in u of the inputs of UAVs with agents, (m_c,)
    uncontrolled: npt.NDArray[np.intp]  # those of UAVs without, (m_u,)
    A_open: Array  # without any feedback, (r, r)
    A: Array  # with the feedback of UAVs without agents, (r, r)
    B: Array  # of the controlled inputs, (r, m_c)
    B_uncontrolled: Array  # (r, m_u)
    CQC: Array  # C'QC, the stage cost of xi, (r, r)
    R: Array  # diagonal of the weights on the controlled inputs, (m_c,)


def _regulator(
    hovering: HoveringTeam, period_s: float, motor_lag_s: float, further: Array | None
) -> Regulator:
    """Return the regulator. Raises also: LinAlgError: numbers overflow."""
    problem = _problem(hovering, period_s, motor_lag_s, further)
    A = problem.A
    B = problem.B
    T = problem.T
    P, discount = _cost_to_go(A, B, problem.CQC, problem.R, may_swing=bool(hovering.uncontrolled))

    # A and B count gamma times with a discount: (45).
    #   K = -(R + gamma^2 B'PB)^-1 gamma^2 B'P A T' = -M^-1 B'P A T',   M = R / gamma^2 + B'PB
    M = np.diag(problem.R) / discount**2 + B.T @ P @ B
    preview_gain = np.negative(np.linalg.solve(M, B.T), dtype=np.float64)
    K = problem.K_fixed.copy()
    K[problem.controlled] = preview_gain @ P @ A @ T.T
    A_closed = A + B @ K[problem.controlled] @ T

    _check_stable(A_closed, period_s)
    _check_gain(K[:, : len(hovering.hover.x)], hovering.cost)
    root = _root(P) @ T.T
    frozen(K, P, root, T, problem.controlled, problem.uncontrolled)
    frozen(problem.A_open, problem.B_uncontrolled, A_closed, preview_gain)
    return Regulator(
        K=K,
        P=P,
        root=root,
        T=T,
        controlled=problem.controlled,
        uncontrolled=problem.uncontrolled,
        A=problem.A_open,
        B_uncontrolled=problem.B_uncontrolled,
        A_closed=A_closed,
        preview_gain=preview_gain,
    )


def _problem(
    hovering: HoveringTeam, period_s: float, motor_lag_s: float, further: Array | None
) -> _Problem:
    """Return difference equation and cost about hover in coordinates xi: (33), (45)."""
    linear, discrete = _about_hover(hovering, period_s, motor_lag_s)
    team = hovering.team
    m = hovering.model.system.m
    T = tangent(hovering.hover.x, team.off, team.released, motors=motor_lag_s > 0.0)

    K_fixed: Array = np.zeros((m, len(T)))
    for uav, gain in hovering.uncontrolled.items():
        K_fixed[state.input_slice(uav), : gain.shape[1]] = gain
    uncontrolled = input_indices(sorted(hovering.uncontrolled))
    controlled = np.delete(np.arange(m), uncontrolled)

    C = linear.C @ T
    CQC = C.T @ (hovering.cost.Q[:, None] * C)
    if further is not None:
        # The user's terms: T' Phi' Phi T, Phi the roots of their weights times their slopes, (48).
        Phi = padded(further, len(T))
        CQC += T.T @ Phi.T @ Phi @ T
    return _Problem(
        T=T,
        K_fixed=K_fixed,
        controlled=controlled,
        uncontrolled=uncontrolled,
        A_open=T.T @ discrete.A @ T,
        A=T.T @ (discrete.A + discrete.B @ K_fixed) @ T,
        B=T.T @ discrete.B[:, controlled],
        B_uncontrolled=T.T @ discrete.B[:, uncontrolled],
        CQC=CQC,
        R=hovering.cost.R[controlled],
    )


def _about_hover(
    hovering: HoveringTeam, period_s: float, motor_lag_s: float
) -> tuple[Linearisation, Discrete]:
    """Return the expansion about hover, with motor lag of [x, a], and its hold."""
    u = hovering.hover.u
    linear = hovering.model.linearise(hovering.hover.x, u)
    if motor_lag_s > 0.0:
        is_rates = hovering.model.system.commands_rates
        linear = with_lag(linear, a=u, u=u, lag_s=motor_lag_s, rates=is_rates)
    return linear, zero_order_hold(linear, period_s)


def _cost_to_go(A: Array, B: Array, Q: Array, R: Array, *, may_swing: bool) -> tuple[Array, float]:
    """Return P and the root of the discount with which it was computed.

    UAVs without agents can swing against each other undamped, out of reach: the cost of that is
    infinite without a discount.
    Raises: FeedbackError: the recursion does not converge.
    """
    try:
        return _riccati(A, B, Q, R), 1.0
    except FeedbackError:
        if not may_swing:
            raise
        return _riccati(_DISCOUNT * A, _DISCOUNT * B, Q, R), _DISCOUNT


def _riccati(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Return the least positive semidefinite solution of the discrete algebraic Riccati equation.

    By doubling, H_j being the recursion after 2^j steps:

        V = (I + G H)^-1,  G <- G + A V G A',  H <- H + A' H V A,  A <- A V A

    Source: docs/equations.md (34).
    """
    identity = np.eye(len(A))
    G = (B / R) @ B.T
    H = Q
    for _ in range(_DOUBLINGS):
        solved = np.linalg.solve(identity + G @ H, np.concatenate([A, G], axis=1))
        VA = solved[:, : len(A)]
        VG = solved[:, len(A) :]
        increment = A.T @ H @ VA

        G = G + A @ VG @ A.T
        H = H + (increment + increment.T) / 2.0
        A = A @ VA
        if np.abs(increment).max() <= _CONVERGED * np.abs(H).max():
            return H
    got = f"a Riccati recursion that has not converged after 2^{_DOUBLINGS} steps"
    raise FeedbackError(f"{_EXPECTED}, got {got}")


def _root(P: Array) -> Array:
    """Return the square root of P by its eigenvectors that have a cost, (rank, r)."""
    eigenvalues, vectors = np.linalg.eigh(P)
    costly = eigenvalues > _RANK * eigenvalues[-1]
    return np.asarray(np.sqrt(eigenvalues[costly])[:, None] * vectors[:, costly].T)


def _check_stable(A_closed: Array, period_s: float) -> None:
    """Check the closed loop: the recursion may converge with an unstable mode out of reach."""
    largest = float(np.abs(np.linalg.eigvals(A_closed)).max())
    if not largest < math.exp(_GROWTH * period_s):
        got = f"a closed loop whose largest eigenvalue is {largest:.3g}"
        raise FeedbackError(f"{_EXPECTED}, got {got}")


def _check_gain(K: Array, cost: Cost) -> None:
    """Check the largest gain: above it rounding alone reaches a mode."""
    gain = float(np.abs(K).max()) / math.sqrt(cost.Q.max() / cost.R.min())
    if not gain < _GAIN:
        raise FeedbackError(f"{_EXPECTED}, got a gain {gain:.3g} times that of an integrator")
