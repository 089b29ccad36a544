"""Search in the unit cube: quasi-random points first, then CMA-ES from the worst of them, restarted.

Deterministic: the same values told give the same points asked, so that a search is resumed by
telling it again what has been evaluated.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import qmc

from transport.model.arrays import Array

BATCH = 8  # points asked at a time; the population of CMA-ES
_RANDOM_PER_DIMENSION = 3  # points before the first start
_SIGMA = 0.25  # first step of CMA-ES, in sides of the cube
_STALL = 8  # generations without progress after which it starts anew
_APART = 0.3  # distance of starts, in sides of the cube and root of the dimension


class Optimiser:
    """Minimiser of a function over the unit cube, by asking for points and being told its values."""

    def __init__(self, dimension: int, *, seed: int) -> None:
        self._dimension = dimension
        self._seed = seed
        self._random_left = _RANDOM_PER_DIMENSION * dimension
        self._sampler = qmc.Sobol(dimension, seed=seed)
        self._points: list[Array] = []
        self._values: list[float] = []
        self._starts: list[Array] = []
        self._evolution: Any = None
        self._stalled = 0

    def ask(self) -> list[Array]:
        """Return the next points, each (dimension,)."""
        if self._random_left > 0:
            self._random_left -= BATCH
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # batches need not be powers of two
                return list(self._sampler.random(BATCH))

        if self._evolution is None or self._evolution.stop() or self._stalled >= _STALL:
            self._start()
        return [np.array(point) for point in self._evolution.ask()]

    def tell(self, points: Sequence[Array], values: Sequence[float]) -> None:
        """Take in the values of all points asked for, in the same order."""
        best_before = min(self._values, default=np.inf)
        self._points += list(points)
        self._values += list(values)
        if self._evolution is None:
            return
        self._evolution.tell(list(points), list(values))
        self._stalled = 0 if min(values) < best_before else self._stalled + 1

    def _start(self) -> None:
        """Start CMA-ES at the best point that is apart from earlier starts."""
        import cma

        order = np.argsort(self._values, kind="stable")
        least = _APART * np.sqrt(self._dimension)
        start = next(
            (
                self._points[index]
                for index in order
                if all(
                    np.linalg.norm(self._points[index] - other) > least for other in self._starts
                )
            ),
            np.random.default_rng([self._seed, len(self._starts)]).random(self._dimension),
        )
        self._starts.append(start)
        self._stalled = 0
        options = {
            "bounds": [0.0, 1.0],
            "popsize": BATCH,
            "seed": 1 + self._seed + 1000 * len(self._starts),  # 0 is the clock's
            "verbose": -9,
            "verb_log": 0,
        }
        self._evolution = cma.CMAEvolutionStrategy(start, _SIGMA, options)
