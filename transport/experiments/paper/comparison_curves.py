"""Curves of the comparison: cost and processor time over the period, relative to the centralized controller."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from transport.experiments.cases import ExperimentError
from transport.experiments.paper.controllers_and_periods import AGENT, NAME, TEAM, Cell, Row
from transport.experiments.statistics import COST_RATIO, PointStatistics, columns_of, estimate
from transport.experiments.sweep import Swept
from transport.model.arrays import Array


@dataclass(frozen=True, slots=True)
class ComparisonCurve:
    """Cost and processor time of a controller over the sampling period.

    Cells are in the order of their periods, the longest first.

    Attributes:
        kept: Whether the horizon is as many "steps" or "seconds" at all periods.
        ratios: Mean cost of each cell and seed over the reference's with that seed, infinite for a
            diverged run.
        loads: Processor time per second of the run of each cell and repetition, by budget, s/s.
    """

    weather: str
    controller: str
    kept: str
    cells: Sequence[Cell]
    measured: Sequence[PointStatistics]
    ratios: Array
    loads: Mapping[str, Array]

    def rows(self) -> Iterator[Row]:
        """Yield a row of curves.csv for each cell."""
        for i, (cell, measured) in enumerate(zip(self.cells, self.measured, strict=True)):
            ratio = estimate(list(self.ratios[i][np.isfinite(self.ratios[i])]))
            row = {"kept": self.kept, **measured.row()}
            row |= columns_of(COST_RATIO, ratio)
            del row["scenario"]

            agent = float(np.median(self.loads[AGENT][i]))
            row["cpu_step_ms"] = 1e3 * cell.period_s * agent
            row["cpu_agent_s_per_s"] = agent
            row["cpu_team_s_per_s"] = float(np.median(self.loads[TEAM][i]))
            yield row

    def cost_ratios(self, period_s: float) -> list[float]:
        """Return the cost over the reference's at a period within the grid, one for each seed.

        Interpolation is linear in the logarithms of cost and period; infinite beside a diverged
        run.
        """
        # From the shortest period on, as interpolation takes increasing abscissas.
        log_periods = np.log([cell.period_s for cell in reversed(self.cells)])
        log_period = math.log(period_s)
        by_seed = self.ratios[::-1].T
        return [math.exp(np.interp(log_period, log_periods, np.log(own))) for own in by_seed]

    def cost_range(self, low_s: float, high_s: float) -> tuple[float, float] | None:
        """Return the lowest and highest cost ratio over the periods within the grid.

        Confidence intervals are included. None if there are no such periods.
        """
        low_s = max(low_s, self.cells[-1].period_s)
        high_s = min(high_s, self.cells[0].period_s)
        if low_s > high_s:
            return None

        inside = [cell.period_s for cell in self.cells if low_s < cell.period_s < high_s]
        ends = [_interval(self.cost_ratios(period_s)) for period_s in (low_s, *inside, high_s)]
        return min(low for low, _ in ends), max(high for _, high in ends)


def _interval(ratios: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % confidence interval of the mean; a single ratio is returned twice."""
    ratio = None if math.inf in ratios else estimate(ratios)
    if ratio is None:
        return math.inf, math.inf
    margin = ratio.half_width or 0.0
    return max(0.0, ratio.mean - margin), ratio.mean + margin  # a cost is never negative


def equal_periods(periods_s: Array, loads: Array) -> tuple[float, float]:
    """Return the range of periods at which a controller computes as much as the reference, s.

    The range is that over all repetitions. The low end is 0 if a repetition computes less even at
    the shortest measured period; the high end is infinite if one computes more even at the longest.
    Between two periods the ratio is interpolated as a power of the period: exact for a constant
    step time, and close for a growing horizon.

    Args:
        periods_s: Sampling periods, from the longest to the shortest.
        loads: Processor time over the reference's, (periods, repetitions).
    """
    log_periods = np.log(periods_s)
    # Interpolation takes increasing abscissas; noise does not count as a decrease.
    log_loads = np.maximum.accumulate(np.log(loads))
    equal_s = [
        math.exp(np.interp(0.0, own, log_periods, left=math.inf, right=-math.inf))
        for own in log_loads.T
    ]
    return min(equal_s), max(equal_s)


def curves_of(
    cells: Mapping[tuple[str, str], Sequence[Cell]], timed: Swept, swept: Swept, reference: Cell
) -> list[ComparisonCurve]:
    """Return the curves in each weather, from the measured runs and those that give the costs.

    Raises: ExperimentError: a run raised an error, or the reference diverged.
    """
    swept.check()
    runs = _Runs(
        measured={tuple(one.point.labels.values()): one for one in swept.measured},
        ratios=_ratios(swept, reference),
        loads=_loads(timed),
    )
    weathers = dict.fromkeys(str(weather) for weather, *_ in runs.ratios)
    return [
        runs.curve(weather, controller, kept, own)
        for weather in weathers
        for (controller, kept), own in cells.items()
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Runs:
    """Runs of all cells.

    Attributes:
        measured: Statistics by weather and cell.
        ratios: Cost over the reference's by weather and cell, (seeds,).
        loads: Processor time per second of the run by budget and cell, s/s, (repeats,).
    """

    measured: Mapping[tuple[Any, ...], PointStatistics]
    ratios: Mapping[tuple[Any, ...], Array]
    loads: Mapping[str, Mapping[Cell, Array]]

    def curve(
        self, weather: str, controller: str, kept: str, cells: Sequence[Cell]
    ) -> ComparisonCurve:
        """Return the curve of some cells in a weather."""
        keys = [(weather, *cell) for cell in cells]
        return ComparisonCurve(
            weather=weather,
            controller=controller,
            kept=kept,
            cells=cells,
            measured=[self.measured[key] for key in keys],
            ratios=np.array([self.ratios[key] for key in keys]),
            loads={
                budget: np.array([by_cell[cell] for cell in cells])
                for budget, by_cell in self.loads.items()
            },
        )


def _ratios(swept: Swept, reference: Cell) -> dict[tuple[Any, ...], Array]:
    """Return the cost of each weather and cell over the reference's with the same seed, (seeds,).

    Infinite for a diverged run.

    Raises: ExperimentError: the reference diverged.
    """
    ends_s = _by_point(swept, "lost_s")  # NaN for completed runs
    costs = _by_point(swept, "cost_mean")
    ratios = {}
    for key, cost in costs.items():
        weather, *_ = key
        reference_key = (weather, *reference)
        reference_cost = costs[reference_key]
        if not (np.isnan(ends_s[reference_key]).all() and reference_cost.all()):
            problem = "expected a centralized controller that completes, got one that does not"
            raise ExperimentError(f"{NAME}: {problem}")
        ratios[key] = np.where(np.isnan(ends_s[key]), cost / reference_cost, math.inf)
    return ratios


def _loads(timed: Swept) -> dict[str, dict[Cell, Array]]:
    """Return the processor time per second of the run of each cell, by budget, s/s, (repeats,)."""
    steps_ms = _by_point(timed, "cpu_step_p50_ms")
    agents = {case.point: len(case.scenario.owned) for case in timed.cases}
    of_team: dict[Cell, Array] = {}
    of_agent: dict[Cell, Array] = {}
    for i, (key, step_ms) in enumerate(steps_ms.items()):
        _, *labels = key
        cell = Cell(*labels)
        of_agent[cell] = step_ms / 1e3 / cell.period_s
        of_team[cell] = agents[i] * of_agent[cell]
    return {TEAM: of_team, AGENT: of_agent}


def _by_point(swept: Swept, name: str) -> dict[tuple[Any, ...], Array]:
    """Return a number of the runs of each point, by its labels; NaN where a run has none."""
    points = zip(swept.experiment.points, swept.by_point, strict=True)
    return {
        tuple(point.labels.values()): np.array(
            [one.numbers.get(name) for one in results], dtype=float
        )
        for point, results in points
    }
