"""Softened distances of owned UAVs and payload from obstacles: docs/equations.md (74a)."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import ClassVar

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.obstacles import Obstacle
from transport.model.physics.parameters import payload_half_size
from transport.model.physics.rotations import euler_rates, rotation
from transport.mpc.program.constraints.block import Block
from transport.mpc.program.decision import Decision
from transport.mpc.program.trajectory import TimeVarying, Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class _Distances:
    """Distances of points from the obstacles beyond the margins."""

    excess: Array  # (obstacles, steps, points), m
    normals: Array  # gradients by the points, (obstacles, steps, points, 3)


class Clearance:
    """Distances of owned UAVs and of the payload's corners; a rod lies between them.

    Each obstacle has a slack of its own.
    """

    in_kernel: ClassVar = False

    def __init__(self, decision: Decision, obstacles: Sequence[Obstacle]) -> None:
        self._obstacles = tuple(obstacles)
        self._own = list(decision.uavs)
        signs = np.array(list(product((-1.0, 1.0), repeat=3)))
        self._corners = signs * payload_half_size(decision.system)  # payload frame, (8, 3), m

        of_points = [
            [obstacle.margin_m] * len(self._own) + [obstacle.load_margin_m] * len(self._corners)
            for obstacle in obstacles
        ]
        self._margins = np.array(of_points)  # (obstacles, points), m

        rows = decision.shape[0] * self._margins.shape[1]
        self.penalties = np.array([obstacle.penalty for obstacle in obstacles])
        self.slack = np.repeat(np.eye(len(obstacles)), rows, axis=0)

    def block(self, trajectory: Trajectory) -> Block:
        """Return the rows distance - margin + slack >= 0 at steps 1..N_p, by obstacle."""
        if not isinstance(trajectory, TimeVarying):
            raise TypeError("expected a trajectory along a reference: others have no obstacles")
        distances = self._distances(trajectory)
        lower = -distances.excess.reshape(-1)
        return Block(
            effect=lambda: self._effect(trajectory, distances.normals),
            lower=lower,
            upper=np.full(len(lower), np.inf),
            slack=self.slack,
        )

    def _distances(self, trajectory: TimeVarying) -> _Distances:
        """Return the distances of all points at steps 1..N_p."""
        X = trajectory.Z[1:]
        R_IP = np.array([rotation(Theta) for Theta in X[:, state.THETA0]])
        corners_I = X[:, None, state.R0] + np.einsum("kij,cj->kci", R_IP, self._corners)
        uavs_I = trajectory.positions.reshape(len(X), -1, 3)[:, self._own]
        points_I = np.concatenate([uavs_I, corners_I], axis=1)

        distances = []
        normals = []
        for obstacle in self._obstacles:
            distance, normal = obstacle.from_points(points_I)
            distances.append(distance)
            normals.append(normal)
        return _Distances(
            excess=np.array(distances) - self._margins[:, None], normals=np.array(normals)
        )

    def _effect(self, trajectory: TimeVarying, normals: Array) -> Array:
        """Return the effect of the decision on all distances, (obstacles steps points, size)."""
        by_step = []
        states = trajectory.effects[0][1:]
        for k, (dx, C) in enumerate(zip(states, trajectory.position_slopes, strict=True)):
            on_points = self._on_points(trajectory.Z[k + 1], dx, C @ dx)
            by_step.append(np.einsum("opi,pis->ops", normals[:, k], on_points))
        return np.array(by_step).transpose(1, 0, 2, 3).reshape(-1, trajectory.decision.size)

    def _on_points(self, x: Array, dx: Array, on_positions: Array) -> Array:
        """Return the effect on owned UAVs and corners at one state, (points, 3, size).

        A corner c of the payload moves by dr0 + d(R c) = dr0 + R (omega x c), with omega the body
        rate per Euler angle. All agents correct the payload: each takes its share of the whole.
        dx is the effect on the state, (n, size), on_positions that on the UAVs, (3 N, size).
        """
        R_IP = rotation(x[state.THETA0])
        omegas = np.linalg.inv(euler_rates(x[state.THETA0])).T
        turned = np.array([np.cross(omega, self._corners) @ R_IP.T for omega in omegas])
        on_corners = dx[state.R0] + np.einsum("aci,as->cis", turned, dx[state.THETA0])

        uavs = len(on_positions) // 3
        on_corners *= uavs / len(self._own)

        on_uavs = on_positions.reshape(uavs, 3, dx.shape[1])[self._own]
        return np.concatenate([on_uavs, on_corners])
