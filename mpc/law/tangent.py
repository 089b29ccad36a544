"""Tangent directions of the state manifold |e_i| = 1, e_i . Omega_i = 0."""

from collections.abc import Collection

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.state import input_indices


def tangent(
    x: Array, off: Collection[int] = (), released: Collection[int] = (), *, motors: bool = False
) -> Array:
    """Return an orthonormal basis of the directions in which a state can change, (n, n - 2 N).

    Without the attitude of UAVs off and the motion of released ones. With motors the basis is that
    of [x, a], actual inputs behind the state.
    Source: docs/equations.md, before (33).
    """
    rods = state.StateView(x).e_P
    each = state.PER_UAV - 2
    basis = np.zeros((len(x), len(x) - 2 * len(rods)))
    basis[: state.PAYLOAD, : state.PAYLOAD] = np.eye(state.PAYLOAD)
    excluded = np.zeros(len(x), dtype=bool)

    for i, e in enumerate(rods):
        across = np.linalg.svd(e[None, :])[2][1:].T  # unit vectors across the rod, (3, 2)
        columns = slice(state.PAYLOAD + each * i, state.PAYLOAD + each * (i + 1))
        own = basis[state.uav_slice(i), columns]
        own[state.E, :2] = across
        own[state.ROD_RATE, 2:4] = across
        own[6:, 4:] = np.eye(6)
        if i in released:
            excluded[state.uav_slice(i)] = True
        elif i in off:
            excluded[state.uav_slice(i)][state.THETA.start :] = True
    basis = basis[:, ~basis[excluded].any(axis=0)]
    return _with_motors(basis, off) if motors else basis


def _with_motors(basis: Array, off: Collection[int]) -> Array:
    """Return the basis with the actual inputs of UAVs with motors as further directions."""
    n, r = basis.shape
    uavs = (n - state.PAYLOAD) // state.PER_UAV
    inputs = np.setdiff1d(np.arange(state.INPUTS * uavs), input_indices(sorted(off)))
    whole = np.zeros((n + state.INPUTS * uavs, r + len(inputs)))
    whole[:n, :r] = basis
    whole[n + inputs, r + np.arange(len(inputs))] = 1.0
    return whole
