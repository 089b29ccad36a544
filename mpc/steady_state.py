"""The steady state of a team under constant external forces, linear in them.

Offset-free MPC: Pannocchia, Rawlings 2003. Source: docs/equations.md (40).
"""

from dataclasses import dataclass

import numpy as np

from transport.model import state
from transport.model.arrays import Array, frozen
from transport.mpc.manifold import tangent
from transport.mpc.regulator import HoveringTeam

# Directions that change a quantity by less, relative to the most, have no effect on it.
_EFFECT = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """The deviation from hover of the steady state under external forces."""

    M_x: Array  # state per newton, (n, 3 + 3 N), SI
    M_u: Array  # input per newton, (m, 3 + 3 N), SI


def target(hovering: HoveringTeam) -> Target:
    """Return the steady state with least output error, then least effort, else as at hover.

    z = [xi, du] solves three problems, each within the solutions of the ones before:

        A xi + B du = -E F and the law of UAVs without agents;  min |C xi|_Q;  min |du|_R

    Source: docs/equations.md (40).
    """
    hover, team = hovering.hover, hovering.team
    linear = hovering.model.linearise(hover.x, hover.u)
    E = hovering.model.force_effect(hover.x, hover.u)
    T = tangent(hover.x, team.off, team.released)
    states = T.shape[1]
    inputs = len(hover.u)

    # Equations of the steady state, and of the inputs of UAVs without agents.
    equations = [T.T @ np.hstack([linear.A_c @ T, linear.B_c])]
    right_sides = [-T.T @ E]
    for uav, K in hovering.uncontrolled.items():
        equations.append(np.hstack([-K @ T, np.eye(inputs)[state.input_slice(uav)]]))
        right_sides.append(np.zeros((len(K), E.shape[1])))
    at_rest = np.vstack(equations)
    forced = np.vstack(right_sides)

    Q_root = np.sqrt(hovering.cost.Q)
    R_root = np.sqrt(hovering.cost.R)
    error = np.hstack([Q_root[:, None] * (linear.C @ T), np.zeros((len(Q_root), inputs))])
    effort = np.hstack([np.zeros((inputs, states)), np.diag(R_root)])

    z = np.zeros((states + inputs, E.shape[1]))
    free = np.eye(states + inputs)  # directions in which z may still move
    for G, h in ((at_rest, forced), (error, 0.0), (effort, 0.0)):
        U, s, Vt = np.linalg.svd(G @ free)
        rank = int((s > _EFFECT * np.linalg.norm(G)).sum())
        missing = U[:, :rank].T @ (h - G @ z)
        z += free @ Vt[:rank].T @ (missing / s[:rank, None])
        free = free @ Vt[rank:].T

    M_x = T @ z[:states]
    M_u = z[states:]
    frozen(M_x, M_u)
    return Target(M_x=M_x, M_u=M_u)
