"""Repetitions into numbers: means with 95 % confidence intervals, and what became of each point of a sweep."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from scipy.special import stdtrit

from transport.experiments.cases import Point
from transport.experiments.flight import ERROR, Result

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean and how well it is known.

    Attributes:
        mean: Of the repetitions.
        half_width: Half the 95 % confidence interval of the mean; None for a single value.
        n: Repetitions.
    """

    mean: float
    half_width: float | None
    n: int


def estimate(values: Sequence[float]) -> Estimate | None:
    """Mean and Student's 95 % confidence interval of independent repetitions; None without any.

    Half the interval is t s / sqrt(n), with the sample's standard deviation s (n - 1 degrees of freedom) and the
    0.975 quantile t of Student's distribution with as many. It is exact for normally distributed values.
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
class Measured:
    """What the flights of a point say.

    Attributes:
        point: The point.
        flights: How many were flown; those that could not be are not among them.
        completed: How many came to the end of the maneuver.
        errors: How many could not be flown.
        lost_s: When the others ended, ascending, scenario time.
        numbers: Estimates over the completed flights, by name (flight.NUMBERS).
        cost_ratio: Mean cost over that of the scenario's flights without impairment (with teams: those of as many
            UAVs; with groups: the group's baseline), if both are known.
    """

    point: Point
    flights: int
    completed: int
    errors: int
    lost_s: tuple[float, ...]
    numbers: Mapping[str, Estimate | None]
    cost_ratio: float | None

    @property
    def first_lost_s(self) -> float | None:
        """When the first flight was lost."""
        return min(self.lost_s, default=None)


def measure(points: Sequence[Point], results: Sequence[Sequence[Result]], names: Sequence[str]) -> list[Measured]:
    """What each point's flights say.

    A flight that was lost has a cost only up to then, which is not comparable; it counts in `completed` and `lost_s`.

    Args:
        points: Of the sweep.
        results: Of each point, in the order of the seeds.
        names: Numbers to estimate.
    """
    costs: dict[tuple[str, str, int], float] = {}
    for point, found in zip(points, results, strict=True):
        cost = estimate(_completed(found, "cost_mean"))
        if point.baseline and cost is not None:
            costs[_compared(point)] = cost.mean
    measured = []
    for point, found in zip(points, results, strict=True):
        flown = [result for result in found if result.outcome != ERROR]
        numbers = {name: estimate(_completed(found, name)) for name in names}
        cost, reference = numbers["cost_mean"], costs.get(_compared(point))
        lost_s = [result.numbers["lost_s"] for result in flown]
        measured.append(
            Measured(
                point=point,
                flights=len(flown),
                completed=sum(result.outcome == "completed" for result in flown),
                errors=len(found) - len(flown),
                lost_s=tuple(sorted(at_s for at_s in lost_s if at_s is not None)),
                numbers=numbers,
                cost_ratio=cost.mean / reference if cost is not None and reference else None,
            )
        )
    return measured


def _compared(point: Point) -> tuple[str, str, int]:
    """What a point has in common with those it is compared to: scenario, group and number of UAVs."""
    return point.scenario, point.group, 0 if point.team is None else point.team.uavs


def _completed(results: Sequence[Result], name: str) -> list[float]:
    """A number of the completed flights that have it."""
    values = [result.numbers[name] for result in results if result.outcome == "completed"]
    return [value for value in values if value is not None]
