"""Smallest distance between the centres of two UAVs, softened: docs/equations.md (29)."""

from itertools import combinations
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from transport.model.arrays import Array
from transport.mpc.program.constraints.block import Block
from transport.mpc.program.decision import Decision
from transport.mpc.program.trajectory import Trajectory
from transport.mpc.settings_period_horizon_weights import SeparationSection as Settings


class Separation:
    """Distances of the pairs of UAVs with an owned one; the others' agents keep the rest."""

    in_kernel: ClassVar = True

    def __init__(self, decision: Decision, settings: Settings) -> None:
        every = combinations(range(decision.system.N), 2)
        with_owned = [pair for pair in every if not set(pair).isdisjoint(decision.uavs)]
        self.pairs = np.array(with_owned, dtype=np.intp).reshape(-1, 2)  # 0-based
        self.minimum_m = settings.minimum_m

        slacks = min(1, len(self.pairs))
        self.penalties = np.full(slacks, settings.penalty)
        self.slack = np.ones((decision.shape[0] * len(self.pairs), slacks))

    def block(self, trajectory: Trajectory) -> Block:
        """Return the rows distance + slack >= minimum at steps 1..N_p."""
        distances = trajectory.of_positions(lambda r: pair_distances(r, self.pairs))
        lower = self.minimum_m - distances.values.reshape(-1)
        return Block(
            effect=lambda: distances.effect,
            lower=lower,
            upper=np.full(len(lower), np.inf),
            slack=self.slack,
        )


def pair_distances(positions: Array, pairs: npt.NDArray[np.intp]) -> tuple[Array, Array]:
    """Return the distances of pairs of points, (..., pairs), m, and their gradients.

    d = |r_i - r_j|, with gradient (r_i - r_j) / d by r_i and the opposite by r_j. Two UAVs in one
    point have no direction; any direction separates them.

    Args:
        positions: r = [r_1, .., r_N], (..., 3 N), m.
        pairs: 0-based numbers i, j, (pairs, 2).
    Returns: Distances, and gradients, (..., pairs, 3 N).
    Source: docs/equations.md (29).
    """
    r = positions.reshape(*positions.shape[:-1], -1, 3)
    apart = r[..., pairs[:, 0], :] - r[..., pairs[:, 1], :]
    distances = np.sqrt((apart * apart).sum(axis=-1))

    together = distances == 0.0
    direction = apart / np.where(together, 1.0, distances)[..., None]
    direction[together] = [1.0, 0.0, 0.0]

    gradients = np.zeros((*distances.shape, r.shape[-2], 3))
    each = np.arange(len(pairs))
    gradients[..., each, pairs[:, 0], :] = direction
    gradients[..., each, pairs[:, 1], :] = -direction
    return distances, gradients.reshape(*distances.shape, positions.shape[-1])
