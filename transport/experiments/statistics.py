"""Statistics of repetitions: means with 95 % confidence intervals, for each point of a sweep."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from scipy.special import stdtrit

from transport.experiments.cases import Point
from transport.experiments.simulation import ERROR, Result

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean with its uncertainty."""

    mean: float
    half_width: float | None  # half the 95 % confidence interval of the mean; None for a single value
    n: int  # number of repetitions


def estimate(values: Sequence[float]) -> Estimate | None:
    """Return mean and Student's 95 % confidence interval of independent repetitions; None without any.

    Half the interval is t s / sqrt(n), with the sample standard deviation s (n - 1 degrees of freedom) and the 0.975
    quantile t of Student's distribution. It is exact for normally distributed values.
    """
    n = len(values)
    if n == 0:
        return None
    mean = math.fsum(values) / n
    if n == 1:
        return Estimate(mean, None, 1)
    variance = math.fsum((value - mean) ** 2 for value in values) / (n - 1)
    t = float(stdtrit(n - 1, 0.5 + CONFIDENCE / 2.0))
    return Estimate(mean, t * math.sqrt(variance / n), n)


@dataclass(frozen=True, slots=True, kw_only=True)
class PointStatistics:
    """Statistics of the runs of one point.

    The cost ratio is the mean cost over that of the baseline, if both are known. The baseline has the same scenario,
    group and number of UAVs.
    """

    point: Point
    runs: int  # number of simulated runs, without errors
    completed: int  # number of runs that reached the end of the maneuver
    errors: int  # number of runs that could not be simulated
    diverged_s: tuple[float, ...]  # scenario times at which the other runs ended, ascending, s
    numbers: Mapping[str, Estimate | None]  # over the completed runs, by name (simulation.NUMBERS)
    cost_ratio: float | None

    @property
    def first_diverged_s(self) -> float | None:
        """Scenario time of the first divergence, s."""
        return min(self.diverged_s, default=None)


def statistics_of(
    points: Sequence[Point], results: Sequence[Sequence[Result]], names: Sequence[str]
) -> list[PointStatistics]:
    """Return the statistics of each point.

    Costs of diverged runs are left out: they cover only part of the maneuver.
    """
    baselines = {
        _comparable(point): cost.mean
        for point, found in zip(points, results, strict=True)
        if point.baseline and (cost := estimate(_completed(found, "cost_mean"))) is not None
    }
    statistics = []
    for point, found in zip(points, results, strict=True):
        simulated = [result for result in found if result.outcome != ERROR]
        numbers = {name: estimate(_completed(found, name)) for name in names}
        cost, baseline = numbers["cost_mean"], baselines.get(_comparable(point))
        ends_s = [result.numbers["lost_s"] for result in simulated]
        statistics.append(
            PointStatistics(
                point=point,
                runs=len(simulated),
                completed=sum(result.outcome == "completed" for result in simulated),
                errors=len(found) - len(simulated),
                diverged_s=tuple(sorted(end_s for end_s in ends_s if end_s is not None)),
                numbers=numbers,
                cost_ratio=cost.mean / baseline if cost is not None and baseline else None,
            )
        )
    return statistics


def _comparable(point: Point) -> tuple[str, str, int]:
    """Return scenario, group and number of UAVs, which a point has in common with its baseline."""
    return point.scenario, point.group, 0 if point.team is None else point.team.uavs


def _completed(results: Sequence[Result], name: str) -> list[float]:
    """Return a number of the completed runs that have it."""
    values = [result.numbers[name] for result in results if result.outcome == "completed"]
    return [value for value in values if value is not None]
