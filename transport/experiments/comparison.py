"""Comparison of centralized and distributed control: processor time and cost at a grid of periods, and the verdicts.

A curve is the mean cost over the sampling period, relative to the centralized controller; grades follow from ranges of
cost ratios alone.
"""

import math
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from transport.experiments.cases import ExperimentError, Point
from transport.experiments.declaration import QUICK_MANEUVER, Experiment
from transport.experiments.statistics import COST_RATIO, PointStatistics, estimate
from transport.experiments.sweep import Swept
from transport.model.arrays import Array

NAME = "paper"

# The paper publishes no weights: its algorithm is run with ours.
CENTRALIZED, PAPER, CLOSED_LOOP = "centralized", "paper's algorithm", "closed loop"
SCENARIOS = {CENTRALIZED: "centralized", PAPER: "paper", CLOSED_LOOP: "paper"}
# The controller of `resilient` with the weights of the others: costs under different weights do not compare.
_CLOSED_LOOP = (
    "controller.prediction=closed_loop",
    "controller.linearisation=along",
    "controller.terminal=riccati",
    "controller.preview=true",
    "controller.received_plans=by_age",
    "controller.relaxation=0.5",
)
STEPS, SECONDS = "steps", "seconds"
STILL, GUSTS = "still air", "gusts"

# The curves: a controller, and whether its horizon keeps the reference's number of steps or of seconds; with the
# shortest period over the reference's. Below it an agent computes more than the reference, and the long horizons take
# more time than all other runs together.
CURVES = {
    (CENTRALIZED, STEPS): 0.0,
    (CENTRALIZED, SECONDS): 0.5,
    (PAPER, SECONDS): 0.4,
    (PAPER, STEPS): 0.0,
    (CLOSED_LOOP, SECONDS): 0.4,
}

# Sampling periods over the reference's: 100 to 15 ms for the paper's 50 ms.
GRID, QUICK_GRID = (2.0, 1.5, 1.0, 0.7, 0.5, 0.4, 0.3), (1.0, 0.5)

# What a verdict holds equal: the rate, or the computation of the whole team or of one agent.
SAME_RATE, TEAM, AGENT = "the same rate", "the whole team", "one agent"

# Maneuver and repetitions of the measurement: long enough to settle, short enough that a repetition sees one machine.
MANEUVER = QUICK_MANEUVER
QUICK_MEASUREMENT = "maneuver.phase=[{name='climb',duration_s=0.4,displacement_m=[0,0,-0.2]}]"
REPEATS, QUICK_REPEATS = 5, 1

# From the best to the worst, and the relative difference of the mean cost up to which each reaches.
GRADES = (
    "much better",
    "better",
    "slightly better",
    "equal",
    "slightly worse",
    "worse",
    "much worse",
    "diverged",
)
_UP_TO = (-0.5, -0.1, -0.005, 0.005, 0.1, 0.5, 1e300)

Row = dict[str, Any]

# Defaults of the common options; the command has a report of its own.
DECLARED = Experiment(name=NAME, seeds=5)


class Cell(NamedTuple):
    """A controller at one sampling period."""

    controller: str
    period_s: float  # T_s
    horizon: int  # N_p, steps


@dataclass(frozen=True, slots=True)
class Curve:
    """Cost and processor time of a controller over the sampling period, from the longest to the shortest.

    Attributes:
        kept: Whether the horizon is as many "steps" or "seconds" at all periods.
        ratios: Mean cost of each cell and seed over the reference's with that seed, infinite for a diverged run.
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
        for i, (cell, m) in enumerate(zip(self.cells, self.measured, strict=True)):
            ratio = estimate(list(self.ratios[i][np.isfinite(self.ratios[i])]))
            row = {"kept": self.kept, **m.row(), COST_RATIO: ratio and ratio.mean}
            row[f"{COST_RATIO}_ci95"] = ratio and ratio.half_width
            del row["scenario"]
            agent, team = (float(np.median(self.loads[budget][i])) for budget in (AGENT, TEAM))
            step_ms = 1e3 * cell.period_s * agent
            yield row | {
                "cpu_step_ms": step_ms,
                "cpu_agent_s_per_s": agent,
                "cpu_team_s_per_s": team,
            }

    def cost_ratios(self, period_s: float) -> list[float]:
        """Return the cost over the reference's at a period within the grid, one for each seed.

        Interpolation is linear in the logarithms of cost and period; infinite beside a diverged run.
        """
        periods = np.log([cell.period_s for cell in reversed(self.cells)])
        return [
            math.exp(np.interp(math.log(period_s), periods, np.log(own)))
            for own in self.ratios[::-1].T
        ]

    def cost_range(self, low_s: float, high_s: float) -> tuple[float, float] | None:
        """Return the lowest and highest cost ratio over the periods within the grid, confidence intervals included.

        None if there are no such periods.
        """
        low_s, high_s = max(low_s, self.cells[-1].period_s), min(high_s, self.cells[0].period_s)
        if low_s > high_s:
            return None
        inside = [cell.period_s for cell in self.cells if low_s < cell.period_s < high_s]
        ends = [_interval(self.cost_ratios(period_s)) for period_s in (low_s, *inside, high_s)]
        return min(low for low, _ in ends), max(high for _, high in ends)


def _interval(ratios: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % confidence interval of the mean; a single ratio is returned twice."""
    if math.inf in ratios or (mean := estimate(ratios)) is None:
        return math.inf, math.inf
    margin = mean.half_width or 0.0
    return max(0.0, mean.mean - margin), mean.mean + margin  # a cost is never negative


def cells_of(reference: Cell, *, quick: bool = False) -> dict[tuple[str, str], list[Cell]]:
    """Return the cells by controller and kept horizon, from the longest period to the shortest; quick gives two."""

    def cell(controller: str, kept: str, factor: float) -> Cell:
        horizon = reference.horizon if kept == STEPS else max(1, round(reference.horizon / factor))
        return Cell(controller, round(factor * reference.period_s, 6), horizon)

    return {
        curve: [
            cell(*curve, factor) for factor in (QUICK_GRID if quick else GRID) if factor >= shortest
        ]
        for curve, shortest in CURVES.items()
    }


def experiment(cells: Sequence[Cell], gust_mps: float) -> Experiment:
    """Return the sweep: every cell in still air and, unless their standard deviation in m/s is zero, in gusts."""
    points = []
    for weather, gust in {STILL: 0.0, **({GUSTS: gust_mps} if gust_mps else {})}.items():
        for cell in cells:
            settings = (
                *(_CLOSED_LOOP if cell.controller == CLOSED_LOOP else ()),
                f"controller.sampling_period_s={cell.period_s!r}",
                f"controller.horizon={cell.horizon}",
                f"plant.wind.gust_mps=[{gust!r},{gust!r},{gust!r}]",
            )
            text = f"{1e3 * cell.period_s:g} ms x {cell.horizon}, {weather}"
            labels = {"weather": weather, **cell._asdict()}
            points.append(Point(labels, text, settings, scenario=SCENARIOS[cell.controller]))
    return replace(DECLARED, points=tuple(points))


def equal_periods(periods_s: Array, loads: Array) -> tuple[float, float]:
    """Return the range of periods at which a controller computes as much as the reference, over all repetitions, s.

    The low end is 0 if a repetition computes less even at the shortest measured period; the high end is infinite if one
    computes more even at the longest. Between two periods the ratio is interpolated as a power of the period: exact for
    a constant step time, and close for a growing horizon.

    Args:
        periods_s: Sampling periods, from the longest to the shortest.
        loads: Processor time over the reference's, (periods, repetitions).
    """
    periods, rising = np.log(periods_s), np.maximum.accumulate(np.log(loads))
    equal_s = [
        math.exp(np.interp(0.0, ratios, periods, left=math.inf, right=-math.inf))
        for ratios in rising.T
    ]
    return min(equal_s), max(equal_s)


def curves_of(
    cells: Mapping[tuple[str, str], Sequence[Cell]], timed: Swept, swept: Swept, reference: Cell
) -> list[Curve]:
    """Return the curves in each weather, from the measured runs and those that give the costs.

    Raises: ExperimentError: a run raised an error, or the reference diverged.
    """
    swept.check()
    statistics = {tuple(m.point.labels.values()): m for m in swept.measured}
    lost, mean = (_by_point(swept, name) for name in ("lost_s", "cost_mean"))
    steps_ms = _by_point(timed, "cpu_step_p50_ms")
    agents = {case.point: len(case.scenario.owned) for case in timed.cases}
    agents_of = {
        point.labels["controller"]: agents[i] for i, point in enumerate(timed.experiment.points)
    }
    curves = []
    for weather in dict.fromkeys(weather for weather, *_ in mean):
        first = (weather, *reference)
        if not (np.isnan(lost[first]).all() and mean[first].all()):
            raise ExperimentError(
                f"{NAME}: expected a centralized controller that completes, got one that does not"
            )
        for (controller, kept), own in cells.items():
            keys = [(weather, *cell) for cell in own]
            ratios = np.array(
                [np.where(np.isnan(lost[key]), mean[key] / mean[first], math.inf) for key in keys]
            )
            agent = np.array([steps_ms[STILL, *cell] / 1e3 / cell.period_s for cell in own])
            loads = {TEAM: agents_of[controller] * agent, AGENT: agent}
            measured = [statistics[key] for key in keys]
            curves.append(Curve(str(weather), controller, kept, own, measured, ratios, loads))
    return curves


def _by_point(swept: Swept, name: str) -> dict[tuple[Any, ...], Array]:
    """Return a number of the runs of each point, by its labels; NaN where a run has none."""
    return {
        tuple(point.labels.values()): np.array(
            [result.numbers[name] for result in results], dtype=float
        )
        for point, results in zip(swept.experiment.points, swept.by_point, strict=True)
    }


def grade(ratio: float) -> str:
    """Return one of `GRADES` for a mean cost over the centralized controller's; infinite for diverged runs."""
    return GRADES[bisect_left(_UP_TO, round(ratio - 1.0, 9))]  # as 1.1 - 1 is above 0.1 in binary


def verdicts(curves: Sequence[Curve], reference: Cell) -> Iterator[Row]:
    """Yield a row of verdict.csv for each distributed curve, at the same rate and at the same computation.

    An end of the periods beyond the grid is empty, the ratio of a diverged run infinite.
    """
    first = curves[0]
    at_reference = {
        budget: loads[first.cells.index(reference)] for budget, loads in first.loads.items()
    }
    for curve in (curve for curve in curves if curve.controller != CENTRALIZED):
        # The processor time of diverging runs is not representative.
        done = np.flatnonzero(np.isfinite(curve.ratios).all(axis=1))
        own = np.array([cell.period_s for cell in curve.cells])[done]
        ranges = (
            {SAME_RATE: (reference.period_s, reference.period_s)} if curve.kept == SECONDS else {}
        )
        for budget, loads in curve.loads.items():
            ranges[budget] = (
                equal_periods(own, loads[done] / at_reference[budget])
                if len(own)
                else (0.0, math.inf)
            )
        for budget, (low_s, high_s) in ranges.items():
            yield _verdict(curve, budget, low_s, high_s)


def _verdict(curve: Curve, budget: str, low_s: float, high_s: float) -> Row:
    """Return the row of a curve over the periods at which it computes as much as the reference."""
    low, high = (f"{1e3 * s:.3g} ms" if 0.0 < s < math.inf else "" for s in (low_s, high_s))
    ratios = curve.cost_range(low_s, high_s)
    row: Row = {
        "weather": curve.weather,
        "controller": curve.controller,
        "at": budget,
        "T_s": "",
        "cost": "",
    }
    if budget != SAME_RATE:
        row["at"] = f"the same computation of {budget}, as many {curve.kept} of horizon"
    if ratios is None:
        row["verdict"] = f"computes {'more' if low_s else 'less'} wherever it completes"
    else:
        grades = [grade(ratio) for ratio in ratios]
        row["T_s"] = " to ".join(
            dict.fromkeys([low or "shorter than the grid", high or "longer than the grid"])
        )
        row["cost"] = " to ".join(dict.fromkeys(f"x{ratio:.2f}" for ratio in ratios)).replace(
            "xinf", "diverged"
        )
        row["verdict"] = " to ".join(dict.fromkeys(grades))
    row["claim"] = row["supported"] = ""
    if curve.controller == PAPER:
        row["claim"] = "slightly worse" if budget == SAME_RATE else "slightly better"
        row["supported"] = "does not apply" if ratios is None else "undetermined"
        if ratios and low and high:
            best, claim, worst = (
                GRADES.index(name) for name in (grades[0], row["claim"], grades[1])
            )
            if not best <= claim <= worst:
                row["supported"] = "does not hold"
            elif best == worst:
                row["supported"] = "holds"
    return row


def sentence(row: Row) -> str:
    """Return a verdict in words, with the paper's claim."""
    where = f"T_s {row['T_s']}, cost {row['cost']}: " if row["cost"] else ""
    claim = f' ("{row["claim"]}" {row["supported"]})' if row["claim"] else ""
    return f"{row['weather']}, {row['controller']}, at {row['at']}: {where}{row['verdict']}{claim}"
