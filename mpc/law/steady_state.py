"""The steady state of a team under constant external forces, linear in them.

Offset-free MPC: Pannocchia, Rawlings 2003. Source: docs/equations.md (40).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from transport.model import state
from transport.model.arrays import Array, frozen
from transport.model.linear.linearisation import Linearisation
from transport.mpc.law.infinite_horizon_lqr import HoveringTeam
from transport.mpc.law.tangent import tangent

# Directions that change a quantity by less, relative to the most, have no effect on it.
_EFFECT = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class SteadyState:
    """The deviation from hover of the steady state under external forces."""

    M_x: Array  # state per newton, (n, 3 + 3 N), SI
    M_u: Array  # input per newton, (m, 3 + 3 N), SI


@dataclass(frozen=True, slots=True, kw_only=True)
class _Equations:
    """Linear equations G z = h of z = [xi, du], a column of h for each force."""

    G: Array
    h: Array


def target(hovering: HoveringTeam) -> SteadyState:
    """Return the steady state with least output error, then least effort, else as at hover.

    z = [xi, du] solves three problems, each within the solutions of the ones before:

        A xi + B du = -E F and the law of UAVs without agents;  min |C xi|_Q;  min |du|_R

    Source: docs/equations.md (40).
    """
    hover = hovering.hover
    linear = hovering.model.linearise(hover.x, hover.u)
    T = tangent(hover.x, hovering.team.off, hovering.team.released)
    at_rest = _at_rest(hovering, linear, T)

    # The roots of Q and R times outputs and inputs, least squares towards zero.
    inputs = len(hover.u)
    Q_root = np.sqrt(hovering.cost.Q)
    R_root = np.sqrt(hovering.cost.R)
    output_error = np.hstack([Q_root[:, None] * (linear.C @ T), np.zeros((len(Q_root), inputs))])
    effort = np.hstack([np.zeros((inputs, T.shape[1])), np.diag(R_root)])

    z = _least_in_turn(at_rest, [output_error, effort])
    M_x = T @ z[: T.shape[1]]
    M_u = z[T.shape[1] :]
    frozen(M_x, M_u)
    return SteadyState(M_x=M_x, M_u=M_u)


def _at_rest(hovering: HoveringTeam, linear: Linearisation, T: Array) -> _Equations:
    """Return the equations of the steady state, and of the inputs of UAVs without agents.

    T'(A_c T xi + B_c du) = -T' E F,  du_i - K_i T xi = 0: (38), (40).
    """
    hover = hovering.hover
    E = hovering.model.force_effect(hover.x, hover.u)
    G = [T.T @ np.hstack([linear.A_c @ T, linear.B_c])]
    h = [-T.T @ E]

    each_input = np.eye(len(hover.u))
    for uav, K in hovering.uncontrolled.items():
        G.append(np.hstack([-K @ T, each_input[state.input_slice(uav)]]))
        h.append(np.zeros((len(K), E.shape[1])))
    return _Equations(G=np.vstack(G), h=np.vstack(h))


def _least_in_turn(equations: _Equations, terms: Sequence[Array]) -> Array:
    """Return z that solves equations and makes |G z| of the terms least, one after the other.

    Each in the least squares within the directions that the ones before leave free.
    """
    unknowns = equations.G.shape[1]
    z = np.zeros((unknowns, equations.h.shape[1]))
    free = np.eye(unknowns)

    problems = [equations, *(_Equations(G=G, h=np.zeros((len(G), 1))) for G in terms)]
    for problem in problems:
        # G free = U S V': z moves along the directions with an effect, the others stay free.
        G = problem.G
        U, s, Vt = np.linalg.svd(G @ free)
        rank = int((s > _EFFECT * np.linalg.norm(G)).sum())
        missing = U[:, :rank].T @ (problem.h - G @ z)
        z += free @ Vt[:rank].T @ (missing / s[:rank, None])
        free = free @ Vt[rank:].T
    return z
