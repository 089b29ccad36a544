"""The target calculation of offset-free MPC: the steady state of the team under constant external forces.

Steering towards hover leaves an offset under such forces; steering towards the steady state that balances them does not
(Pannocchia, Rawlings 2003; Maeder, Borrelli, Morari 2009).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from model import state
from model.arrays import Array, frozen
from model.hover import Hover
from model.linearisation import Model
from mpc.cost import Cost
from mpc.feedback import tangent

# Directions that change a quantity by less than this share of the largest change count as without effect.
_RANK = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """The deviation from hover of the steady state under external forces, linear in them.

    Attributes:
        M_x: State per newton, (n, 3 + 3 N), SI.
        M_u: Input per newton, (m, 3 + 3 N), SI.
    """

    M_x: Array
    M_u: Array


def target(
    model: Model,
    hover: Hover,
    cost: Cost,
    uncontrolled: Mapping[int, Array] | None = None,
    off: Collection[int] = (),
    released: Collection[int] = (),
) -> Target:
    """Return the steady state of the linearisation about hover with least output error, then least input effort.

    Remaining free directions, such as the headings of the UAVs, stay as at hover. A steady state exists for any forces:
    rods lean in parallel or pull in proportion, a remaining moment tilts the payload, and thrusts balance their rods.

    Attitudes of UAVs without motors and all states of released UAVs are not part of the target. Arguments as those of
    `mpc.feedback.regulator`. Source: docs/equations.md (40).
    """
    linear = model.linearise(hover.x, hover.u)
    E = model.force_effect(hover.x, hover.u)
    T = tangent(hover.x, off, released)
    states, inputs = T.shape[1], len(hover.u)
    at_rest = [(T.T @ np.hstack([linear.A_c @ T, linear.B_c]), -T.T @ E)]
    for uav, K in (uncontrolled or {}).items():
        own_law = np.hstack([-K @ T[state.uav_slice(uav)], np.eye(inputs)[state.input_slice(uav)]])
        at_rest.append((own_law, np.zeros((len(K), E.shape[1]))))
    rest, pushed = (np.vstack(rows) for rows in zip(*at_rest, strict=True))
    error = np.hstack([np.sqrt(cost.Q)[:, None] * (linear.C @ T), np.zeros((len(cost.Q), inputs))])
    effort = np.hstack([np.zeros((inputs, states)), np.diag(np.sqrt(cost.R))])
    z = np.zeros((states + inputs, E.shape[1]))
    free = np.eye(states + inputs)  # directions in which z may still move
    for G, h in ((rest, pushed), (error, 0.0), (effort, 0.0)):
        U, s, Vt = np.linalg.svd(G @ free)
        rank = int((s > _RANK * np.linalg.norm(G)).sum())
        z += free @ Vt[:rank].T @ ((U[:, :rank].T @ (h - G @ z)) / s[:rank, None])
        free = free @ Vt[rank:].T
    M_x, M_u = T @ z[:states], z[states:]
    frozen(M_x, M_u)
    return Target(M_x=M_x, M_u=M_u)
