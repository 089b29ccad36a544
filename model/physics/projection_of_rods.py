"""Projection of the rods onto the manifold |e_i| = 1, e_i . Omega_i = 0, and its derivative."""

import casadi as ca

from transport.model import state


def project(x: ca.SX, N: int) -> ca.SX:
    """Return the state with the rods projected back onto |e_i| = 1 and e_i . Omega_i = 0: (13a)."""
    parts = [x[: state.PAYLOAD]]
    for i in range(N):
        block = x[state.uav_slice(i)]
        # e <- e / |e|,  Omega <- Omega - e (e . Omega)
        e = block[state.E] / ca.norm_2(block[state.E])
        Omega = block[state.ROD_RATE]
        parts += [e, Omega - e * ca.dot(e, Omega), block[state.THETA], block[state.OMEGA]]
    return ca.vertcat(*parts)


def projection(x: ca.SX, N: int) -> ca.SX:
    """Return the derivative of `project` on the manifold, (n, n), sparse.

    Source: docs/equations.md (15a).
    """
    parts = [ca.SX.eye(state.PAYLOAD)]
    for i in range(N):
        block = x[state.uav_slice(i)]
        e = block[state.E]
        Omega = block[state.ROD_RATE]

        # Pi_i = [I - e e', 0; -e Omega', I - e e']
        across = ca.SX.eye(3) - e @ e.T
        rod = ca.vertcat(ca.horzcat(across, ca.SX(3, 3)), ca.horzcat(-e @ Omega.T, across))
        parts += [rod, ca.SX.eye(state.PER_UAV - 6)]
    return ca.diagcat(*parts)
