"""Cost curves: mean cost over the sampling period, relative to the centralized controller and interpolated."""

import bisect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from transport.experiments.comparison import Cell, Curves, PeriodRange
from transport.experiments.simulation import NUMBERS
from transport.experiments.statistics import Estimate, estimate
from transport.experiments.sweep import Swept

COST = "cost_mean"


@dataclass(frozen=True, slots=True, kw_only=True)
class Node:
    """Runs of a cell in one weather.

    Runs, times of divergence, and numbers are as in `PointStatistics`.
    """

    cell: Cell
    runs: int
    diverged_s: tuple[float, ...]
    numbers: Mapping[str, Estimate | None]
    ratios: Mapping[str, Mapping[int, float]]  # by name, of each seed over the reference's with that seed (same wind)

    @property
    def completed(self) -> int:
        """Number of runs that reached the end of the maneuver."""
        return self.runs - len(self.diverged_s)

    def ratio(self, name: str) -> Estimate | None:
        """Return the mean of the ratios over the seeds."""
        return estimate(list(self.ratios.get(name, {}).values()))


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Cost of a controller over the sampling period, in one weather.

    Its horizon keeps the reference's "steps" or "seconds". The nodes are from the longest period to the shortest.
    """

    controller: str
    kept: str
    weather: str
    nodes: tuple[Node, ...]

    def cost_ratios(self, period_s: float) -> list[float]:
        """Return the mean cost over the reference's at a period within the grid, one for each seed.

        Interpolation is linear in the logarithms of cost and period. Infinite if a neighbour on the grid has a
        diverged run; empty if a neighbour could not be simulated.
        """
        nodes = self.nodes[::-1]
        place = bisect.bisect_left([node.cell.period_s for node in nodes], period_s)
        above = nodes[min(place, len(nodes) - 1)]
        below = above if above.cell.period_s == period_s else nodes[max(place - 1, 0)]
        if above.diverged_s or below.diverged_s:
            return [math.inf]
        first, second = below.ratios.get(COST, {}), above.ratios.get(COST, {})
        step = math.log(above.cell.period_s / below.cell.period_s)
        share = math.log(period_s / below.cell.period_s) / step if step else 0.0
        return [first[seed] ** (1.0 - share) * second[seed] ** share for seed in first if seed in second]

    def cost_range(self, periods: PeriodRange) -> tuple[float, float] | None:
        """Return the lowest and highest cost ratio over a range of periods, confidence intervals included.

        Args:
            periods: The range; the part beyond the grid is left out.
        Returns: None if the range is outside the grid, or a period needed could not be simulated.
        """
        shortest_s, longest_s = self.nodes[-1].cell.period_s, self.nodes[0].cell.period_s
        low_s, high_s = max(periods.low_s, shortest_s), min(periods.high_s, longest_s)
        if low_s > high_s:
            return None
        inside = [node.cell.period_s for node in self.nodes if low_s < node.cell.period_s < high_s]
        ranges = [_interval(self.cost_ratios(period_s)) for period_s in (low_s, *inside, high_s)]
        found = [interval for interval in ranges if interval is not None]
        if len(found) < len(ranges):
            return None
        return min(low for low, _ in found), max(high for _, high in found)


def _interval(ratios: Sequence[float]) -> tuple[float, float] | None:
    """Return the 95 % confidence interval of the mean; a single ratio is returned twice."""
    if math.inf in ratios:
        return math.inf, math.inf
    mean = estimate(ratios)
    if mean is None:
        return None
    margin = mean.half_width or 0.0
    return max(0.0, mean.mean - margin), mean.mean + margin  # a cost is never negative


def cost_curves(curves: Curves, swept: Swept) -> list[Curve]:
    """Return the curves in each weather, each run relative to the reference's with the same seed."""
    points = swept.experiment.points
    completed: list[dict[int, Mapping[str, float | None]]] = [{} for _ in points]
    for case, result in zip(swept.cases, swept.results, strict=True):
        if result.outcome == "completed":
            completed[case.point][case.scenario.seed] = result.numbers
    names = NUMBERS[1:]  # lost_s is in PointStatistics.diverged_s
    references = {
        point.labels["weather"]: found for point, found in zip(points, completed, strict=True) if point.baseline
    }
    nodes: dict[tuple[str, Cell], Node] = {}
    for m, found in zip(swept.measured, completed, strict=True):
        labels: dict[str, Any] = dict(m.point.labels)
        weather = labels.pop("weather")
        nodes[weather, Cell(**labels)] = Node(
            cell=Cell(**labels),
            runs=m.runs,
            diverged_s=m.diverged_s,
            numbers=m.numbers,
            ratios={name: _ratios(name, found, references[weather]) for name in names},
        )
    return [
        Curve(controller=controller, kept=kept, weather=weather, nodes=tuple(nodes[weather, cell] for cell in cells))
        for weather in map(str, references)
        for (controller, kept), cells in curves.items()
    ]


def _ratios(
    name: str, found: Mapping[int, Mapping[str, float | None]], reference: Mapping[int, Mapping[str, float | None]]
) -> dict[int, float]:
    ratios = {}
    for seed, numbers in found.items():
        own, first = numbers.get(name), reference.get(seed, {}).get(name)
        if own is not None and first:
            ratios[seed] = own / first
    return ratios
