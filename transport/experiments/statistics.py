"""Statistics of repetitions: means with 95 % confidence intervals of each point of a sweep."""

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from scipy.special import stdtrit

from transport.experiments.cases import Point
from transport.experiments.simulation import ERROR, Result

# Numbers of a point beside those of its runs.
FIRST_DIVERGED = "first_lost_s"
COST_RATIO = "cost_ratio"
WORST_ATTITUDE = "attitude_worst_deg"

# Quantile of Student's distribution at the upper end of a 95 % confidence interval.
_QUANTILE = 0.975
# Fewer values than these are shown with their range: the interval of two or three can exceed their mean.
FEW = 5


class Estimate(NamedTuple):
    """A mean with its uncertainty."""

    mean: float
    # Half the 95 % confidence interval of the mean; None for a single value.
    half_width: float | None
    n: int  # number of repetitions
    low: float  # smallest and largest value
    high: float

    def bar(self) -> tuple[float, float]:
        """Return the lengths of an error bar below and above the mean.

        It is the 95 % interval, no further than to zero for values that are all positive. The interval of
        fewer than five values is wider than the axis: their range stands for it.
        """
        if self.half_width is None:
            return 0.0, 0.0
        if self.n < FEW:
            return max(0.0, self.mean - self.low), max(0.0, self.high - self.mean)  # rounding
        below = min(self.half_width, self.mean) if self.low >= 0.0 else self.half_width
        return below, self.half_width

    def scaled(self, factor: float) -> "Estimate":
        """Return the estimate in another unit, for a factor above zero."""
        half_width = None if self.half_width is None else factor * self.half_width
        return Estimate(
            factor * self.mean, half_width, self.n, factor * self.low, factor * self.high
        )

    def text(self, digits: int) -> str:
        """Return the mean with half its interval, with the range of fewer than five values."""
        return with_spread(self._asdict(), lambda value: f"{value:.{digits}f}")


def with_spread(values: Mapping[str, Any], text: Callable[[float], str]) -> str:
    """Return a mean in words with half its interval, with its range if n is below five, alone if n is one.

    Args:
        values: The fields of an `Estimate`.
        text: Returns a number as text.
    """
    mean = text(values["mean"])
    if values["half_width"] is None:
        return mean
    if values["n"] < FEW:
        return f"{mean} [{text(values['low'])}, {text(values['high'])}]"
    return f"{mean} ±{text(values['half_width'])}"


def estimate(values: Sequence[float]) -> Estimate | None:
    """Return mean and Student's 95 % confidence interval of independent repetitions.

    Half the interval is t s / sqrt(n), with the sample standard deviation s (n - 1 degrees of
    freedom) and the 0.975 quantile t of Student's distribution. It is exact for normally
    distributed values. None without any values.
    """
    n = len(values)
    if n == 0:
        return None

    mean = math.fsum(values) / n
    if n == 1:
        return Estimate(mean, None, n, mean, mean)
    t = float(stdtrit(n - 1, _QUANTILE))
    s = statistics.stdev(values)
    return Estimate(mean, t * s / math.sqrt(n), n, min(values), max(values))


@dataclass(frozen=True, slots=True, kw_only=True)
class PointStatistics:
    """Statistics of the runs of one point.

    The cost ratio is the mean cost over that of the baseline, if both are known. The baseline has
    the same scenario and group.
    """

    point: Point
    runs: int  # number of simulated runs, without errors
    completed: int  # number of runs that reached the end of the maneuver
    errors: int  # number of runs that could not be simulated
    diverged_s: tuple[float, ...]  # scenario times at which the other runs ended, ascending, s
    numbers: Mapping[str, Estimate | None]  # over the completed runs, by name (cases.NUMBERS)
    cost_ratio: float | None
    attitude_worst_deg: float | None = None  # over the completed runs

    def mean(self, name: str) -> float | None:
        """Return the mean of a number, or the cost ratio; None where no run was completed."""
        if name == COST_RATIO:
            return self.cost_ratio
        value = self.numbers[name]
        return None if value is None else value.mean

    def estimate(self, name: str) -> Estimate | None:
        """Return a number with its uncertainty; that of the cost ratio is the cost's, scaled."""
        if name != COST_RATIO:
            return self.numbers[name]
        cost = self.numbers["cost_mean"]
        if cost is None or self.cost_ratio is None:
            return None
        return cost.scaled(self.cost_ratio / cost.mean)._replace(mean=self.cost_ratio)

    def bar(self, name: str) -> tuple[float, float]:
        """Return the lengths of the error bar of a number."""
        value = self.estimate(name)
        return (0.0, 0.0) if value is None else value.bar()

    def row(self) -> dict[str, Any]:
        """Return values by column, as in points.csv."""
        row: dict[str, Any] = {
            "scenario": self.point.scenario,
            **self.point.labels,
            "flights": self.runs,
            "completed": self.completed,
            "errors": self.errors,
            FIRST_DIVERGED: min(self.diverged_s, default=None),
            COST_RATIO: self.cost_ratio,
            WORST_ATTITUDE: self.attitude_worst_deg,
        }
        for name, value in self.numbers.items():
            row |= columns_of(name, value)
        return row


def values_of(measured: Iterable[PointStatistics], column: str) -> list[str | float]:
    """Return the values of a column of points, each once, in their order."""
    return list(dict.fromkeys(one.point.labels[column] for one in measured))


def bars_in_words(measured: Iterable[PointStatistics], names: Sequence[str]) -> str:
    """Return what the error bars of some numbers are; empty without any."""
    values = [one.estimate(name) for one in measured for name in names]
    counts = sorted({value.n for value in values if value is not None and value.n > 1})
    if not counts:
        return ""
    runs = " to ".join(f"{count}" for count in dict.fromkeys((counts[0], counts[-1])))
    if counts[-1] < FEW:
        return f"bars: range of {runs} runs"
    few = f", ranges of fewer than {FEW}" if counts[0] < FEW else ""
    return f"bars: 95 % intervals of {runs} runs{few}"


def columns_of(name: str, value: Estimate | None) -> dict[str, float | None]:
    """Return the columns of a number in points.csv: mean, half its interval, smallest and largest value."""
    names = (name, *(f"{name}_{ending}" for ending in ("ci95", "min", "max")))
    if value is None:
        return dict.fromkeys(names)
    return dict(zip(names, (value.mean, value.half_width, value.low, value.high), strict=True))


def statistics_of(
    points: Sequence[Point], results: Sequence[Sequence[Result]], names: Sequence[str]
) -> list[PointStatistics]:
    """Return the statistics of each point.

    Costs of diverged runs are left out: they cover only part of the maneuver.
    """
    measured = [_of_point(point, own, names) for point, own in zip(points, results, strict=True)]
    baselines = {
        (one.point.scenario, one.point.group): one.mean("cost_mean")
        for one in measured
        if one.point.baseline
    }
    return [
        replace(one, cost_ratio=_ratio(one, baselines.get((one.point.scenario, one.point.group))))
        for one in measured
    ]


def _of_point(point: Point, results: Sequence[Result], names: Sequence[str]) -> PointStatistics:
    """Return the statistics of the runs of a point, without its cost ratio."""
    simulated = [result for result in results if result.outcome != ERROR]
    completed = [result.numbers for result in simulated if result.outcome == "completed"]
    ends_s = [result.numbers["lost_s"] for result in simulated]

    estimates = {}
    for name in names:
        values = [numbers.get(name) for numbers in completed]
        estimates[name] = estimate([value for value in values if value is not None])
    return PointStatistics(
        point=point,
        runs=len(simulated),
        completed=len(completed),
        errors=len(results) - len(simulated),
        diverged_s=tuple(sorted(end_s for end_s in ends_s if end_s is not None)),
        numbers=estimates,
        cost_ratio=None,
        attitude_worst_deg=max(
            (numbers.get("attitude_max_deg") or 0.0 for numbers in completed), default=None
        ),
    )


def _ratio(measured: PointStatistics, baseline: float | None) -> float | None:
    """Return the mean cost over that of the baseline, if both are known."""
    if not baseline:
        return None
    cost = measured.mean("cost_mean")
    return None if cost is None else cost / baseline
