"""The optimiser of a search: its draws, the turns of its generations, the starts of its descent."""

from collections.abc import Sequence
from typing import Any

import cma
import numpy as np
import pytest

from transport.model.arrays import Array
from transport.search.optimiser import BATCH, Descent, Optimiser, SearchLayout

SEED = 3
# Three events: the first coordinate of each of the longer ones has a severe end.
LAYOUT = SearchLayout(
    events=(slice(0, 2), slice(2, 4), slice(4, 5)),
    severe=np.array([True, False, True, False, False]),
)
RANDOM = 16  # points before the first generation
STALL = 4  # generations without progress before the next start
SOME_VALUE, WORSE_VALUE = 1.0, 0.5


class Evolution:
    """In place of CMA-ES: it asks for its start, and keeps how it was begun."""

    begun: list["Evolution"]

    def __init__(self, start: Array, sigma: float, options: dict[str, Any]) -> None:
        self.start = start
        self.sigma = sigma
        self.options = options
        self.seed = options["seed"]
        self.has_stopped = False
        self.begun.append(self)

    def stop(self) -> bool:
        """Return whether the evolution has ended by itself."""
        return self.has_stopped

    def ask(self) -> list[Array]:
        """Return the points of a generation."""
        return [self.start] * BATCH

    def tell(self, points: Sequence[Array], values: Sequence[float]) -> None:
        """Take in the values of a generation."""


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[Evolution]:
    """Return the evolutions begun so far, none of which searches."""
    monkeypatch.setattr(Evolution, "begun", [], raising=False)
    monkeypatch.setattr(cma, "CMAEvolutionStrategy", Evolution)
    return Evolution.begun


def known(number: int) -> Array:
    """Return a point whose coordinates are all different, and differ from those of another number."""
    return (number + np.arange(5) / 5.0) / RANDOM


def after_the_random_points() -> Optimiser:
    """Return an optimiser that was told points of the test in place of the random ones, the worst first."""
    optimiser = Optimiser(LAYOUT, seed=SEED)
    for first in (0, BATCH):
        optimiser.ask()
        numbers = range(first, first + BATCH)
        optimiser.tell([known(number) for number in numbers], [float(number) for number in numbers])
    return optimiser


def test_uniform_numbers_are_drawn_towards_the_severe_ends() -> None:
    """A severe coordinate is u^(1/6), above one half from u = 1/64 on; the others stay."""
    uniform = np.array([0.0, 1.0 / 64.0, 0.25, 729.0 / 4096.0, 1.0])
    points = np.tile(uniform[:, None], LAYOUT.dimension)
    towards_one = [0.0, 0.5, 0.793701, 0.75, 1.0]  # 0.25^(1/6) = 2^(-1/3)

    found = LAYOUT.severely(points)
    for coordinate in (0, 2):
        assert found[:, coordinate] == pytest.approx(towards_one, abs=1e-6)
    for coordinate in (1, 3, 4):
        assert found[:, coordinate].tolist() == uniform.tolist()


def test_the_random_points_are_drawn_towards_the_severe_ends() -> None:
    """Of all 16, at most one has a severe coordinate below one half, and about half another one."""
    optimiser = Optimiser(LAYOUT, seed=SEED)
    points: list[Array] = []
    for _ in range(RANDOM // BATCH):
        asked = optimiser.ask()
        optimiser.tell(asked, [SOME_VALUE] * BATCH)
        points += asked
    above = np.sum(np.array(points) > 0.5, axis=0)
    assert (above[[0, 2]] >= RANDOM - 1).all()
    assert above[[1, 3, 4]] == pytest.approx([RANDOM / 2] * 3, abs=1)


def test_generations_alternate_and_that_of_cma_es_is_the_first(begun: list[Evolution]) -> None:
    """CMA-ES starts at the worst point told so far; each other generation is one of the evolution."""
    optimiser = after_the_random_points()
    assert begun == []

    is_of_descent = []
    for _ in range(4):
        asked = optimiser.ask()
        is_of_descent.append(all((point == known(0)).all() for point in asked))
        optimiser.tell(asked, [100.0] * BATCH)
    assert is_of_descent == [True, False, True, False]
    assert [one.start.tolist() for one in begun] == [known(0).tolist()]
    (one,) = begun
    assert one.sigma == 0.25  # of the sides of the cube, in which it stays
    assert (one.options["bounds"], one.options["popsize"]) == ([0.0, 1.0], BATCH)


@pytest.mark.usefixtures("begun")
def test_the_order_of_the_draws_is_kept() -> None:
    """The points of a generation of the evolution, for one seed, are those of earlier searches.

    A stopped search is resumed by asking again: other draws would ask for other points.
    """
    optimiser = after_the_random_points()
    optimiser.tell(optimiser.ask(), [100.0] * BATCH)
    expected = [
        [0.786563, 0.801274, 0.913778, 0.094129, 0.433127],  # drawn anew
        [0.0, 0.0, 0.025, 0.0375, 0.05],
        [0.0625, 0.075, 0.025, 0.0375, 0.773277],  # the middle event is that of the worst point
        [0.402251, 0.119441, 0.3375, 0.35, 0.3],
        [0.47621, 0.672022, 0.4625, 0.475, 0.4875],
        [0.5, 0.5125, 0.541738, 0.481674, 0.55],
        [0.0, 0.0125, 0.614976, 0.128365, 0.10018],
        [0.13157, 0.129984, 0.763541, 0.295456, 0.2375],
    ]
    assert np.array(optimiser.ask()) == pytest.approx(np.array(expected), abs=1e-6)


def descended(descent: Descent, worst_first: Sequence[Array], values: Sequence[float]) -> None:
    """Ask for a generation for each value, and tell the value as that of all its points."""
    for value in values:
        descent.tell(descent.ask(worst_first), [value] * BATCH)


def towards(distance: float) -> Array:
    """Return the point at a distance from the corner of the cube, (4,), on its diagonal."""
    return np.full(4, distance / 2.0)


def test_a_descent_without_progress_starts_anew_apart_from_earlier_starts(
    begun: list[Evolution],
) -> None:
    """The next start is the worst point farther than 0.3 sqrt(4) = 0.6 from all; else one is drawn."""
    descent = Descent(4, seed=SEED)
    worst_first = [towards(0.0), towards(0.59), towards(0.61), towards(1.22)]
    for count in (1, 2, 3, 4):
        descended(descent, worst_first, [SOME_VALUE] + [SOME_VALUE] * STALL)
        assert len(begun) == count
    starts = np.array([one.start for one in begun])
    assert starts[:3] == pytest.approx(np.array([towards(0.0), towards(0.61), towards(1.22)]))
    assert starts[3] == pytest.approx([0.1028, 0.319947, 0.999082, 0.192827], abs=1e-6)
    assert [one.seed for one in begun] == [1 + SEED + 1000 * count for count in (1, 2, 3, 4)]


def test_progress_keeps_a_descent(begun: list[Evolution]) -> None:
    """Generations without progress are counted from the last one that has made some."""
    descent = Descent(4, seed=SEED)
    worst_first = [towards(0.0), towards(1.0)]
    stalled = [SOME_VALUE] * (STALL - 1)
    descended(descent, worst_first, [SOME_VALUE, *stalled, WORSE_VALUE, *stalled, SOME_VALUE])
    assert len(begun) == 1
    descent.ask(worst_first)
    assert len(begun) == 2


def test_a_new_start_has_progress_of_its_own(begun: list[Evolution]) -> None:
    """Its first generation is progress, whatever the earlier descent has found."""
    descent = Descent(4, seed=SEED)
    worst_first = [towards(0.0), towards(1.0), towards(2.0)]
    descended(descent, worst_first, [WORSE_VALUE] * (1 + STALL))
    descended(descent, worst_first, [SOME_VALUE] * (1 + STALL))
    assert len(begun) == 2


def test_an_evolution_that_has_stopped_is_followed_by_another(begun: list[Evolution]) -> None:
    """CMA-ES stops by itself at the bottom of a valley."""
    descent = Descent(4, seed=SEED)
    worst_first = [towards(0.0), towards(1.0)]
    descended(descent, worst_first, [SOME_VALUE])
    begun[0].has_stopped = True
    assert descent.ask(worst_first)[0].tolist() == towards(1.0).tolist()


def test_random_points_at_once_are_those_of_batches() -> None:
    """As many batches as are left and reach the number asked for, at least one."""
    at_once, by_batches = Optimiser(LAYOUT, seed=SEED), Optimiser(LAYOUT, seed=SEED)
    expected = by_batches.ask() + by_batches.ask()

    assert len(at_once.ask(BATCH + 1)) == RANDOM
    assert np.array_equal(Optimiser(LAYOUT, seed=SEED).ask(100), expected)
    assert np.array_equal(Optimiser(LAYOUT, seed=SEED).ask(1), expected[:BATCH])

    # One for each dimension, in whole batches.
    many = SearchLayout(events=(slice(0, 20),), severe=np.zeros(20, dtype=bool))
    assert len(Optimiser(many, seed=SEED).ask(100)) == 3 * BATCH
