"""Search in the unit cube: severe points first, then the worst of them changed, one event at a time.

The smallest value is the worst case, which the search looks for. Three sources of points:

- Quasi-random ones at first, drawn towards the severe ends of coordinates that have one: longer
  silences, stronger gusts.
- Then, in turns, a generation of an evolution, which changes one or two events of a bad point or
  takes events from another: a failure is a coincidence of few events, of which the others are no
  part.
- And one of CMA-ES (package `cma`), which follows a valley from the worst point. When it stalls, it
  starts anew from the worst point apart from its earlier starts.

Deterministic: the same values told, in the same order, give the same points asked, so that a search is
resumed by asking and telling again what has been evaluated.
"""

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from transport.model.arrays import Array

BATCH = 8  # points asked at a time; the population of CMA-ES
_LEAST_RANDOM = 16  # points before the first generation, one for each dimension, at least these
_SEVERITY = 6.0  # a severe coordinate is u^(1/6): above one half with probability 0.98
_SIGMA = 0.25  # first step of CMA-ES, in sides of the cube
_STALL = 4  # generations of CMA-ES without progress after which it starts anew
_SEEDS_APART = 1000  # of the seeds of two starts: each draws other numbers
_APART = 0.3  # least distance of starts, as a multiple of the root of the dimension

# Evolution.
_PRESSURE = 0.25  # a parent is the worst point with this probability, else the next with it, ...
_STEPS = (0.02, 0.3)  # standard deviation of a change, log-uniform between, sides of the cube
_REDRAWN = 0.15  # share of the coordinates of a changed event that are drawn anew
_CROSSED = 0.3  # share of the points with events of a second parent
_OF_SECOND = 0.5  # share of the events that these have from it
_FRESH = 0.1  # share of the points that are drawn anew
_MOST_CHANGES = 2  # events of a child that are changed


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchLayout:
    """Coordinates of the unit cube: those of each event, and which ones have a severe end."""

    events: tuple[slice, ...]
    severe: Array  # (dimension,), true where 1 is worse than 0

    @property
    def dimension(self) -> int:
        """Return the number of coordinates."""
        return len(self.severe)

    def severely(self, points: Array) -> Array:
        """Return uniform points, (..., dimension), drawn towards the severe ends."""
        return _towards_one(points, self.severe)


def _towards_one(uniform: Array, severe: Array) -> Array:
    """Return uniform numbers in which those of severe coordinates are drawn towards 1."""
    return np.where(severe, uniform ** (1.0 / _SEVERITY), uniform)


class Optimiser:
    """Minimiser of a function over the unit cube, by asking for points and being told its values."""

    def __init__(self, layout: SearchLayout, *, seed: int) -> None:
        from scipy.stats import qmc  # 0.2 s, in which the workers of a search start

        self._layout = layout
        self._random_left = max(_LEAST_RANDOM, layout.dimension)
        self._sampler = qmc.Sobol(layout.dimension, seed=seed)
        self._rng = np.random.default_rng(seed)
        self._descent = Descent(layout.dimension, seed=seed)
        self._next_is_descent = False  # whether the next generation is one of CMA-ES
        self._points: list[Array] = []
        self._values: list[float] = []

    def ask(self, most: int = BATCH) -> list[Array]:
        """Return the next points, each (dimension,).

        They are a batch, or as many batches of random points as are left, at least one, that reach the
        most: random points do not depend on values, so that no processor waits for the end of a batch.
        """
        if self._random_left > 0:
            count = BATCH * math.ceil(min(self._random_left, most) / BATCH)
            self._random_left -= count
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # batches need not be powers of two
                return list(self._layout.severely(self._sampler.random(count)))

        # The smallest value is the worst.
        order = np.argsort(self._values, kind="stable")
        worst_first = [self._points[index] for index in order]
        if self._next_is_descent:
            return self._descent.ask(worst_first)
        return [self._child(worst_first) for _ in range(BATCH)]

    def tell(self, points: Sequence[Array], values: Sequence[float]) -> None:
        """Take in the values of all points asked for, in the same order."""
        if self._next_is_descent:
            self._descent.tell(points, values)
        self._points += list(points)
        self._values += list(values)

        # After the random points generations alternate, CMA-ES first.
        random_points_are_done = self._random_left <= 0
        self._next_is_descent = random_points_are_done and not self._next_is_descent

    def _child(self, worst_first: Sequence[Array]) -> Array:
        """Return a point whose events are those of bad points, one or two of them changed."""
        rng = self._rng
        layout = self._layout
        if rng.random() < _FRESH:
            return layout.severely(rng.random(layout.dimension))

        child = self._parent(worst_first).copy()
        if rng.random() < _CROSSED:
            other = self._parent(worst_first)
            for event in layout.events:
                if rng.random() < _OF_SECOND:
                    child[event] = other[event]

        changes = min(len(layout.events), int(rng.integers(1, _MOST_CHANGES + 1)))
        for index in rng.choice(len(layout.events), changes, replace=False):
            event = layout.events[index]
            child[event] = self._changed(child[event], layout.severe[event])
        return child

    def _parent(self, worst_first: Sequence[Array]) -> Array:
        """Return a bad point, the worse the more often."""
        rank = int(self._rng.geometric(_PRESSURE)) - 1
        return worst_first[min(rank, len(worst_first) - 1)]

    def _changed(self, event: Array, severe: Array) -> Array:
        """Return coordinates of an event a step away, some of them drawn anew."""
        rng = self._rng
        low, high = np.log(_STEPS)
        # The order of the draws decides a search: it stays.
        step = np.exp(rng.uniform(low, high))
        direction = rng.standard_normal(len(event))
        moved = event + step * direction
        drawn = _towards_one(rng.random(len(event)), severe)
        is_drawn = rng.random(len(event)) < _REDRAWN
        return np.clip(np.where(is_drawn, drawn, moved), 0.0, 1.0)


class Descent:
    """CMA-ES from the worst point, anew from the worst that is apart from earlier starts."""

    def __init__(self, dimension: int, *, seed: int) -> None:
        self._dimension = dimension
        self._seed = seed
        self._starts: list[Array] = []
        self._evolution: Any = None
        self._random: Any = None  # state of numpy's global generator within this search
        self._worst = np.inf
        self._stalled = 0

    def ask(self, worst_first: Sequence[Array]) -> list[Array]:
        """Return the next generation; a new start is at one of the points known so far."""
        with self._own_random():
            if self._evolution is None or self._evolution.stop() or self._stalled >= _STALL:
                self._start(worst_first)
            return [np.array(point) for point in self._evolution.ask()]

    def tell(self, points: Sequence[Array], values: Sequence[float]) -> None:
        """Take in the values of the generation."""
        with self._own_random():
            self._evolution.tell(list(points), list(values))
        self._stalled = 0 if min(values) < self._worst else self._stalled + 1
        self._worst = min(self._worst, *values)

    @contextmanager
    def _own_random(self) -> Iterator[None]:
        """Keep numpy's global generator, from which the package draws, apart from other users of it."""
        outside = np.random.get_state()
        if self._random is not None:
            np.random.set_state(self._random)
        try:
            yield
        finally:
            self._random = np.random.get_state()
            np.random.set_state(outside)

    def _start(self, worst_first: Sequence[Array]) -> None:
        """Start at the worst point that is apart from earlier starts, else anywhere."""
        start = next((point for point in worst_first if self._is_apart(point)), None)
        if start is None:
            start = np.random.default_rng([self._seed, len(self._starts)]).random(self._dimension)

        self._starts.append(start)
        self._worst = np.inf
        self._stalled = 0
        options = {
            "bounds": [0.0, 1.0],
            "popsize": BATCH,
            "seed": 1 + self._seed + _SEEDS_APART * len(self._starts),  # 0 is the clock's
            "verbose": -9,
            "verb_log": 0,
        }
        import cma  # 0.2 s, which a search of random points alone does not need

        self._evolution = cma.CMAEvolutionStrategy(start, _SIGMA, options)

    def _is_apart(self, point: Array) -> bool:
        """Return whether a point is far from all starts."""
        least = _APART * np.sqrt(self._dimension)
        return all(float(np.linalg.norm(point - start)) > least for start in self._starts)
