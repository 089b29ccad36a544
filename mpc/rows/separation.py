"""Separation: the smallest distance of any two UAVs."""

from itertools import combinations

import numpy as np
import numpy.typing as npt

from model import native, state
from model.arrays import Array
from mpc import condensing
from mpc.decision import Decision
from mpc.rows.interface import Block, StepData


class SeparationRows:
    """Smallest distance of all pairs with an owned UAV, softened by one slack. Source: docs/equations.md (29)."""

    def __init__(self, decision: Decision) -> None:
        separation, self._pairs = decision.settings.separation, pairs_of(decision.system.N, decision.uavs)
        if separation is None:
            self._pairs = self._pairs[:0]
        self._minimum_m = 0.0 if separation is None else separation.minimum_m
        self.penalties = np.array([separation.penalty] if separation is not None and len(self._pairs) else [])
        self._steps, self._decisions = decision.settings.horizon, decision.size

    def template(self) -> Array:
        """Return the slack's column."""
        rows = np.zeros((self._steps * len(self._pairs), self._decisions + len(self.penalties)))
        rows[:, self._decisions :] = 1.0
        return rows

    def fill(self, step: StepData, to: Block) -> None:
        """Write the distances' dependence on the decision, and how much of the minimum is missing."""
        effect, distance = _distances(self._pairs, step)
        condensing.fill(effect, to.A)
        np.subtract(self._minimum_m, distance.reshape(-1), out=to.lower)


def _distances(pairs: npt.NDArray[np.intp], step: StepData) -> tuple[Array, Array]:
    """Return the effect of decisions on distances, (pairs, N_p, m_own), and those without decision, (N_p, pairs)."""
    if native.AVAILABLE:
        return native.distances(pairs, step.linear.model.y, step.positions, step.position_effect)
    return _plain_distances(pairs, step)


def _plain_distances(pairs: npt.NDArray[np.intp], step: StepData) -> tuple[Array, Array]:
    N = (len(step.linear.x0) - state.PAYLOAD) // state.PER_UAV
    _, direction = separation_rows(step.linear.model.y[: 3 * N], pairs)
    effect = step.position_effect[: 3 * N]
    by = (direction @ effect.reshape(len(effect), -1)).reshape(-1, *effect.shape[1:])
    return by, step.positions[:, : 3 * N] @ direction.T


def pairs_of(N: int, owned: tuple[int, ...]) -> npt.NDArray[np.intp]:
    """Return the pairs of UAVs, 0-based, with at least one owned UAV, (pairs, 2); the others' agents keep the rest."""
    pairs = [pair for pair in combinations(range(N), 2) if pair[0] in owned or pair[1] in owned]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def separation_rows(positions: Array, pairs: npt.NDArray[np.intp]) -> tuple[Array, Array]:
    """Return pairwise distances of the UAVs as linear functions of their positions.

    |r_i - r_j| is replaced by d' (r_i - r_j), d the present direction: a lower bound, so that keeping it
    above the limit keeps the actual distance above it too.

    The positions are those at the linearisation point, (3 N,), m; the pairs are UAVs, 0-based, (pairs, 2).

    Returns: Distances now, (pairs,), m; rows with distance = row . positions, (pairs, 3 N).
    Source: docs/equations.md (29).
    """
    r = positions.reshape(-1, 3)
    apart = r[pairs[:, 0]] - r[pairs[:, 1]]
    distances = np.sqrt((apart * apart).sum(axis=1))
    # Two UAVs in one point have no direction; any direction separates them.
    together = distances == 0.0
    d = apart / np.where(together, 1.0, distances)[:, None]
    d[together] = [1.0, 0.0, 0.0]
    rows = np.zeros((len(pairs), len(positions)))
    for row, (i, j), direction in zip(rows, pairs.tolist(), d, strict=True):
        row[3 * i : 3 * i + 3] = direction
        row[3 * j : 3 * j + 3] = -direction
    return distances, rows
