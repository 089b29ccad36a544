"""Repetitions into numbers.

The confidence interval against theory and scipy.stats, and what counts for a point.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from transport.experiments.cases import Point
from transport.experiments.result_tables import Column
from transport.experiments.run_numbers import NUMBERS
from transport.experiments.simulation import ERROR, Result
from transport.experiments.statistics import COST_RATIO, bars_in_words, estimate, statistics_of

BASELINE = Point(scenario="a", labels={"delay_s": 0.0}, text="0 ms", baseline=True)
LATE = Point(scenario="a", labels={"delay_s": 0.1}, text="100 ms")


def result(outcome: str = "completed", cost: float = 1.0, lost_s: float | None = None) -> Result:
    """Return the result of a run."""
    numbers: dict[str, float | None] = dict.fromkeys(NUMBERS)
    numbers |= {"cost_mean": cost, "lost_s": lost_s}
    return Result(key="k", outcome=outcome, reason="", numbers={} if outcome == ERROR else numbers)


@pytest.mark.parametrize("n", [2, 3, 5, 10, 200])
def test_interval_is_students(n: int) -> None:
    """The interval is that of scipy.stats for any number of repetitions, also of numbers far from zero."""
    values = 100.0 + np.random.default_rng(n).normal(size=n)
    found = estimate(list(values))
    assert found is not None
    assert found.half_width is not None
    low, high = stats.t.interval(0.95, n - 1, loc=values.mean(), scale=stats.sem(values))
    tolerance = 1e-9  # scipy subtracts the mean in another order
    assert found.mean - found.half_width == pytest.approx(low, abs=tolerance)
    assert found.mean + found.half_width == pytest.approx(high, abs=tolerance)


def test_error_bars_stay_on_the_axis() -> None:
    """Bars are the interval, not below zero where no value is; a range where values are few."""
    spread = estimate([0.1, 0.2, 0.1, 0.2, 4.0])
    assert spread is not None
    assert spread.half_width is not None
    assert spread.half_width > spread.mean
    assert spread.bar() == (spread.mean, spread.half_width)

    from_zero = estimate([0.0, 0.2, 0.1, 0.2, 4.0])
    assert from_zero is not None
    assert from_zero.bar()[0] == from_zero.mean

    signed = estimate([-0.1, 0.2, 0.1, 0.2, 4.0])
    assert signed is not None
    assert signed.bar() == (signed.half_width, signed.half_width)

    few = estimate([1.0, 2.0, 6.0])
    assert few is not None
    assert few.bar() == (2.0, 3.0)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([2.0], "2.0"),
        ([1.0, 3.0], "2.0 [1.0, 3.0]"),  # half the interval is 12.7
        ([1.0, 2.0, 3.0, 6.0], "3.0 [1.0, 6.0]"),
        ([1.0, 2.0, 3.0, 4.0, 5.0], "3.0 ±2.0"),
    ],
)
def test_few_values_are_told_with_their_range(values: list[float], text: str) -> None:
    """A single value stands alone, five have their interval; so in the column of a table, with its factor."""
    found = estimate(values)
    assert found is not None
    assert found.text(1) == text

    results = [result(cost=value) for value in values]
    (point,) = statistics_of([BASELINE], [results], NUMBERS[1:])
    assert Column("", "cost_mean", digits=1, interval=True).cell(point.row()) == text
    scaled = Column("", "cost_mean", 10.0, 0, interval=True).cell(point.row())
    assert scaled == text.replace(".0", "0")


def test_the_cost_ratio_has_the_spread_of_the_cost() -> None:
    """Its interval and its range are the cost's over the baseline's cost."""
    costs = [2.0, 4.0]
    base, late = statistics_of(
        [BASELINE, LATE], [[result(cost=1.5)], [result(cost=cost) for cost in costs]], NUMBERS[1:]
    )
    ratio = late.estimate(COST_RATIO)
    assert ratio is not None
    assert (ratio.mean, ratio.low, ratio.high) == pytest.approx((2.0, 2.0 / 1.5, 4.0 / 1.5))
    assert base.estimate(COST_RATIO) == (1.0, None, 1, 1.0, 1.0)


def test_a_point_tells_its_first_divergence_its_worst_attitude_and_the_ratio_in_its_group() -> None:
    """The baseline is that of the same scenario and group; a worst attitude is that of a completed run."""

    def flown(outcome: str, attitude_deg: float, lost_s: float | None = None) -> Result:
        one = result(outcome, lost_s=lost_s)
        return replace(one, numbers=one.numbers | {"attitude_max_deg": attitude_deg})

    other = replace(BASELINE, group="b")
    late = replace(LATE, group="b")
    base, _, measured = statistics_of(
        [other, replace(other, scenario="c"), late],
        [
            [result(cost=0.5)],
            [result(cost=4.0)],
            [
                flown("diverged", 90.0, 7.5),
                flown("completed", 3.0),
                flown("diverged", 80.0, 2.5),
                flown("completed", 8.0),
            ],
        ],
        NUMBERS[1:],
    )
    row = measured.row()
    assert (row["first_lost_s"], row["attitude_worst_deg"]) == (2.5, 8.0)
    assert (base.cost_ratio, measured.cost_ratio) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("counts", "text"),
    [
        ([1, 1], ""),
        ([3, 3], "bars: range of 3 runs"),
        ([2, 4], "bars: range of 2 to 4 runs"),
        ([5, 8], "bars: 95 % intervals of 5 to 8 runs"),
        ([3, 8], "bars: 95 % intervals of 3 to 8 runs, ranges of fewer than 5"),
    ],
)
def test_bars_are_named_by_the_number_of_runs(counts: list[int], text: str) -> None:
    """Ranges of fewer than five, intervals of more, or both; a single run has no bar."""
    measured = statistics_of(
        [BASELINE, LATE], [[result(cost=1.0 + k) for k in range(n)] for n in counts], NUMBERS[1:]
    )
    assert bars_in_words(measured, ["cost_mean"]) == text


def test_diverged_runs_count_but_are_not_averaged() -> None:
    """Cost is averaged over completed runs.

    A diverged run counts, with its time; errors are separate.
    """
    results = [
        result(cost=2.0),
        result("diverged", cost=9.0, lost_s=14.3),
        result(cost=4.0),
        result(ERROR),
    ]
    base, late = statistics_of([BASELINE, LATE], [[result(cost=1.5)], results], NUMBERS[1:])
    assert (late.runs, late.completed, late.errors, late.diverged_s) == (3, 2, 1, (14.3,))
    cost = late.numbers["cost_mean"]
    assert cost is not None
    assert (cost.mean, cost.n) == (3.0, 2)
    assert (base.cost_ratio, late.cost_ratio) == (1.0, 2.0)
