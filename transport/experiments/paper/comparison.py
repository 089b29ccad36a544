"""Comparison of centralized and distributed control: cost and processor time over the period.

A curve is the mean cost over the sampling period, relative to the centralized controller.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from transport.experiments.cases import ExperimentError, Point
from transport.experiments.declaration import QUICK_MANEUVER, Experiment
from transport.experiments.statistics import COST_RATIO, PointStatistics, columns_of, estimate
from transport.experiments.sweep import Swept
from transport.model.arrays import Array

NAME = "paper"

# The paper publishes no weights: its algorithm is run with ours.
CENTRALIZED = "centralized"
PAPER = "paper's algorithm"
CLOSED_LOOP = "closed loop"
SCENARIOS = {CENTRALIZED: "centralized", PAPER: "paper", CLOSED_LOOP: "paper"}
# The controller of `resilient` with the weights of the others: costs under different weights do not
# compare.
_CLOSED_LOOP = (
    "controller.prediction=closed_loop",
    "controller.linearisation=along",
    "controller.terminal=riccati",
    "controller.preview=true",
    "controller.received_plans=by_age",
    "controller.relaxation=0.5",
)
# Length of the horizon that a curve keeps.
STEPS = "steps"
SECONDS = "seconds"
# Weathers.
STILL = "still air"
GUSTS = "gusts"

# The curves: a controller, and whether its horizon keeps the reference's number of steps or of
# seconds; with the shortest period over the reference's. Below it an agent computes more than the
# reference, and the long horizons take more time than all other runs together. The first is the
# reference's own: verdicts and figure read the reference from it.
CURVES = {
    (CENTRALIZED, STEPS): 0.0,
    (CENTRALIZED, SECONDS): 0.5,
    (PAPER, SECONDS): 0.4,
    (PAPER, STEPS): 0.0,
    (CLOSED_LOOP, SECONDS): 0.4,
}

# Sampling periods over the reference's, falling: 100 to 15 ms for the paper's 50 ms. Both grids
# have the reference itself, 1.0.
GRID = (2.0, 1.5, 1.0, 0.7, 0.5, 0.4, 0.3)
QUICK_GRID = (1.0, 0.5)

# Budgets of computation: of the whole team and of one agent.
TEAM = "the whole team"
AGENT = "one agent"

# Maneuver and repetitions of the measurement: long enough to settle, short enough that a repetition
# sees one machine.
MANEUVER = QUICK_MANEUVER
QUICK_MEASUREMENT = "maneuver.phase=[{name='climb',duration_s=0.4,displacement_m=[0,0,-0.2]}]"
REPEATS = 5
QUICK_REPEATS = 1

Row = dict[str, Any]

# Defaults of the common options; the command has a report and scenarios of its own.
DECLARED = Experiment(name=NAME, seeds=5, scenarios=())


class Cell(NamedTuple):
    """A controller at one sampling period."""

    controller: str
    period_s: float  # T_s
    horizon: int  # N_p, steps


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


def cells_of(reference: Cell, *, quick: bool = False) -> dict[tuple[str, str], list[Cell]]:
    """Return the cells by controller and kept horizon, from the longest period to the shortest.

    Quick gives two.
    """
    grid = QUICK_GRID if quick else GRID

    def cell(controller: str, kept: str, factor: float) -> Cell:
        horizon = reference.horizon if kept == STEPS else max(1, round(reference.horizon / factor))
        return Cell(controller, round(factor * reference.period_s, 6), horizon)

    return {
        curve: [cell(*curve, factor) for factor in grid if factor >= shortest]
        for curve, shortest in CURVES.items()
    }


def experiment(cells: Sequence[Cell], gust_mps: float) -> Experiment:
    """Return the sweep: every cell in still air and in gusts.

    There are no gusts if their standard deviation, m/s, is zero.
    """
    weathers = {STILL: 0.0}
    if gust_mps:
        weathers[GUSTS] = gust_mps
    points = [_point(cell, weather, gust) for weather, gust in weathers.items() for cell in cells]
    return replace(DECLARED, points=tuple(points))


def _point(cell: Cell, weather: str, gust_mps: float) -> Point:
    """Return a cell in a weather as a point of the sweep."""
    settings = (
        *(_CLOSED_LOOP if cell.controller == CLOSED_LOOP else ()),
        f"controller.sampling_period_s={cell.period_s!r}",
        f"controller.horizon={cell.horizon}",
        f"plant.wind.gust_mps=[{gust_mps!r},{gust_mps!r},{gust_mps!r}]",
    )
    text = f"{1e3 * cell.period_s:g} ms x {cell.horizon}, {weather}"
    labels = {"weather": weather, **cell._asdict()}
    return Point(labels, text, settings, scenario=SCENARIOS[cell.controller])


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
