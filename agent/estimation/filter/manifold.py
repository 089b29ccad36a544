"""Manifold of states with rods of unit length: coordinates of small errors, and the retraction.

A rod direction and its rate obey |e_i| = 1 and e_i . Omega_i = 0, so they have two degrees of
freedom each, not three. In coordinates of the state, the directions along the rods would keep their
first variance for ever, and positions would correct the lengths of rods.
"""

from dataclasses import dataclass

import numpy as np

from transport.model import state
from transport.model.arrays import Array

# Coordinates of one UAV's block, in the order of its states: e 2, Omega 2, Theta 3, omega 3.
UAV_BLOCKS = (2, 2, 3, 3)
PER_UAV = sum(UAV_BLOCKS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Basis:
    """Coordinates xi of small deviations dx about a state; equations.md (62).

    dx = T xi,    xi = L' dx,    L' T = I
    """

    T: Array  # (n, r); with motor lag (n + m, r + m)
    L: Array  # the same shape


class Manifold:
    """Manifold of a team of N UAVs; actual inputs of lagging motors join its states as they are.

    Attributes:
        r: Number of coordinates of a state, 12 + 10 N, without the actual inputs.
    """

    def __init__(self, N: int, actual_inputs: int = 0) -> None:
        n = state.PAYLOAD + state.PER_UAV * N
        self.r = state.PAYLOAD + PER_UAV * N
        self._N = N

        # All of the basis but the rods: payload, attitudes and rates of the UAVs, actual inputs.
        attitude_and_rate = np.vstack([np.zeros((6, PER_UAV)), np.eye(6, PER_UAV, k=4)])
        self._frame = np.zeros((n + actual_inputs, self.r + actual_inputs))
        self._frame[: state.PAYLOAD, : state.PAYLOAD] = np.eye(state.PAYLOAD)
        self._frame[state.PAYLOAD : n, state.PAYLOAD : self.r] = np.kron(
            np.eye(N), attitude_and_rate
        )
        self._frame[n:, self.r :] = np.eye(actual_inputs)

        # Places of the rods in it, (N, 3, 2) by broadcasting: rows and columns of e and Omega.
        uavs = np.arange(N)[:, None, None]
        rows = state.PAYLOAD + state.PER_UAV * uavs + np.arange(3)[:, None]
        columns = state.PAYLOAD + PER_UAV * uavs + np.arange(2)
        self._e_places = (rows + state.E.start, columns)
        self._rate_places = (rows + state.ROD_RATE.start, columns + 2)
        self._rate_by_e_places = (rows + state.ROD_RATE.start, columns)

    def basis(self, x: Array) -> Basis:
        """Return the basis about a state, (n,), with motor lag (n + m,).

        Source: docs/equations.md (62).
        """
        e, Omega = self._rods(x)
        B = _across(e)

        #   delta e     = B xi_e
        #   delta Omega = B xi_Omega - e Omega' B xi_e
        L = self._frame.copy()
        L[self._e_places] = B
        L[self._rate_places] = B

        T = L.copy()
        T[self._rate_by_e_places] = -e[:, :, None] * np.einsum("ij,ijk->ik", Omega, B)[:, None, :]
        return Basis(T=T, L=L)

    def moved(self, x: Array, dx: Array) -> Array:
        """Return the state x (+) dx, read-only, both (n,), SI, restored to the manifold.

        Source: docs/equations.md (62).
        """
        x = x + dx
        e, Omega = self._rods(x)

        #   e <- e / |e|,    Omega <- Omega - e (e . Omega)
        e /= np.sqrt(np.einsum("ij,ij->i", e, e))[:, None]
        Omega -= e * np.einsum("ij,ij->i", e, Omega)[:, None]

        x.setflags(write=False)
        return x

    def _rods(self, x: Array) -> tuple[Array, Array]:
        """Return views of rod directions and rates, (N, 3) each, in a state."""
        end = state.PAYLOAD + state.PER_UAV * self._N
        uavs = x[state.PAYLOAD : end].reshape(self._N, -1)
        return uavs[:, state.E], uavs[:, state.ROD_RATE]


def _across(e: Array) -> Array:
    """Return two unit vectors across each rod direction, (N, 3, 2), from directions, (N, 3).

    They are the images of the x and y axes under the reflection that maps e to the z axis, and so
    are smooth around the hover.
    """
    #   w = e +- k,    B = (I - 2 w w' / w'w) [i j]
    w = e.copy()
    w[:, 2] += np.where(e[:, 2] < 0.0, -1.0, 1.0)
    scale = 2.0 / np.einsum("ij,ij->i", w, w)
    reflected: Array = np.eye(3, 2) - scale[:, None, None] * w[:, :, None] * w[:, None, :2]
    return reflected
