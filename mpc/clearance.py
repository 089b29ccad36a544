"""Constraint rows that keep owned UAVs and the payload's corners clear of obstacles along a predicted trajectory."""

from collections.abc import Sequence

import numpy as np

from model import state
from model.arrays import Array
from model.obstacles import Obstacle
from model.parameters import payload_corners
from model.rotations import euler_rates, rotation
from mpc.decision import Decision


class Clearance:
    """Distances of the owned UAVs' centres and of the payload's corners from obstacles, as far as they are limited.

    A rod lies between a UAV and the payload. Source: docs/equations.md (74a).
    """

    def __init__(self, decision: Decision, obstacles: Sequence[Obstacle]) -> None:
        self._obstacles, self._own = obstacles, list(decision.uavs)
        self._corners = payload_corners(decision.system)
        margins = [[obstacle.margin_m] * len(self._own) + [obstacle.load_margin_m] * 8 for obstacle in obstacles]
        self._margins = np.array(margins).reshape(len(obstacles), -1)
        self.penalties = np.array([obstacle.penalty for obstacle in obstacles])  # weight of the slack of each

    def excess(self, Z: Array, places: Array) -> tuple[Array, Array]:
        """Return distances beyond the margins at states, (obstacles, k, points), m, and their gradients, (..., 3).

        Given are states, (k, n), and positions of all UAVs, (k, N, 3).
        """
        R = np.array([rotation(Theta) for Theta in Z[:, state.THETA0]])
        corners = Z[:, None, state.R0] + np.einsum("kij,cj->kci", R, self._corners)
        points = np.concatenate([places[:, self._own], corners], axis=1)
        distances, normals = zip(*(obstacle.from_points(points) for obstacle in self._obstacles), strict=True)
        return np.array(distances) - self._margins[:, None], np.array(normals)

    def rows(self, x: Array, normals: Array, effect: Array, on_places: Array) -> Array:
        """Return the effect of a decision on the distances at one state, (obstacles, points, size).

        Given are their gradients, (obstacles, points, 3), and the decision's effect on the state, (n, size), and on the
        positions of all UAVs, (3 N, size).
        """
        R, omegas = rotation(x[state.THETA0]), np.linalg.inv(euler_rates(x[state.THETA0])).T
        turned = np.array([np.cross(omega, self._corners) @ R.T for omega in omegas])
        # All agents correct the payload's distance: each its share of what they do together.
        on_corners = effect[state.R0] + np.einsum("aci,as->cis", turned, effect[state.THETA0])
        on_corners *= len(on_places) // 3 / len(self._own)
        on_points = np.concatenate([on_places.reshape(-1, 3, effect.shape[1])[self._own], on_corners])
        return np.asarray(np.einsum("opi,pis->ops", normals, on_points))
