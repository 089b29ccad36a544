"""Comparison of centralized and distributed control: processor time and cost at a grid of periods, and the verdicts.

A curve is the mean cost over the sampling period, relative to the centralized controller; grades follow from ranges of
cost ratios alone.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from model.arrays import Array
from transport.experiments.cases import ExperimentError, Point
from transport.experiments.declaration import QUICK_MANEUVER, Declaration, Experiment, axis
from transport.experiments.statistics import COST_RATIO, estimate
from transport.experiments.sweep import Swept

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
    (PAPER, STEPS): 0.0,
    (PAPER, SECONDS): 0.4,
    (CLOSED_LOOP, SECONDS): 0.4,
}

# Sampling periods over the reference's: 100 to 15 ms for the paper's 50 ms.
GRID, QUICK_GRID = (2.0, 1.5, 1.0, 0.7, 0.5, 0.4, 0.3), (1.0, 0.5)

# What a verdict holds equal: the rate, or the computation of the whole team or of one agent.
SAME_RATE, TEAM, AGENT = "same rate", "whole team", "one agent"

# Maneuver and repetitions of the measurement: long enough to settle, short enough that a repetition sees one machine.
MANEUVER = QUICK_MANEUVER
QUICK_MEASUREMENT = "maneuver.phase=[{name='climb',duration_s=0.4,displacement_m=[0,0,-0.2]}]"
REPEATS, QUICK_REPEATS = 5, 1

# Relative differences of the mean cost: up to the first equal, up to the second slightly, beyond the third much.
_EQUAL, _SLIGHT, _MUCH = 0.005, 0.1, 0.5

# From the best to the worst: a range of ratios covers all grades between its ends.
GRADES = ("much better", "better", "slightly better", "equal", "slightly worse", "worse", "much worse", "diverged")
_MORE, _LESS = "computes more wherever it completes", "computes less wherever it completes"

Row = dict[str, Any]

# Defaults of the common options; the command has a report of its own.
DECLARED = Declaration(build=lambda: (), options={}, drawn={}, seeds=5)


class Cell(NamedTuple):
    """A controller at one sampling period."""

    controller: str
    period_s: float  # T_s
    horizon: int  # N_p, steps


# Processor time per second of the run by budget and cell, in each repetition, s/s.
Loads = Mapping[str, Mapping[Cell, Array]]


@dataclass(frozen=True, slots=True)
class Curve:
    """Cost of a controller over the sampling period in one weather; its horizon keeps "steps" or "seconds".

    Attributes:
        rows: A row of curves.csv for each cell, from the longest period to the shortest.
        costs: Mean cost of each cell and seed over the reference's with that seed, infinite for a diverged run.
    """

    weather: str
    controller: str
    kept: str
    cells: Sequence[Cell]
    rows: Sequence[Row]
    costs: Array

    @property
    def periods_s(self) -> Array:
        """Sampling periods, from the longest to the shortest."""
        return np.array([cell.period_s for cell in self.cells])

    def cost_ratios(self, period_s: float) -> list[float]:
        """Return the cost over the reference's at a period within the grid, one for each seed.

        Interpolation is linear in the logarithms of cost and period; infinite beside a diverged run.
        """
        for own, costs in zip(self.periods_s, self.costs, strict=True):
            if own == period_s:
                return list(costs)
        at, periods = math.log(period_s), np.log(self.periods_s[::-1])
        return [math.exp(np.interp(at, periods, np.log(costs[::-1]))) for costs in self.costs.T]

    def cost_range(self, low_s: float, high_s: float) -> tuple[float, float] | None:
        """Return the lowest and highest cost ratio over the periods within the grid, confidence intervals included.

        None if there are no such periods.
        """
        low_s, high_s = max(low_s, self.periods_s[-1]), min(high_s, self.periods_s[0])
        if low_s > high_s:
            return None
        inside = [period_s for period_s in self.periods_s if low_s < period_s < high_s]
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
    cells: dict[tuple[str, str], list[Cell]] = {}
    for (controller, kept), shortest in CURVES.items():
        for factor in (factor for factor in (QUICK_GRID if quick else GRID) if factor >= shortest):
            horizon = reference.horizon if kept == STEPS else max(1, round(reference.horizon / factor))
            cell = Cell(controller, round(factor * reference.period_s, 6), horizon)
            cells.setdefault((controller, kept), []).append(cell)
    return cells


def experiment(cells: Sequence[Cell], reference: Cell, gust_mps: float) -> Experiment:
    """Return the sweep: every cell in still air and, unless their standard deviation in m/s is zero, in gusts."""
    weathers = {STILL: 0.0, **({GUSTS: gust_mps} if gust_mps > 0.0 else {})}
    points = []
    for weather, gust in weathers.items():
        for cell in cells:
            settings = [
                *(_CLOSED_LOOP if cell.controller == CLOSED_LOOP else ()),
                f"controller.sampling_period_s={cell.period_s!r}",
                f"controller.horizon={cell.horizon}",
                f"plant.wind.gust_mps=[{gust!r},{gust!r},{gust!r}]",
                # A step of the plant is at most one period.
                *([f"plant.step_s={cell.period_s!r}"] if cell.period_s < 0.01 else []),
            ]
            point = Point(
                {"weather": weather, **cell._asdict()},
                f"{1e3 * cell.period_s:g} ms x {cell.horizon}, {weather}",
                tuple(settings),
                baseline=cell == reference,
                group=weather,
                scenario=SCENARIOS[cell.controller],
            )
            points.append(point)
    return Experiment(name=NAME, points=tuple(points), x=axis("period_s"))


def loads_of(timed: Swept) -> Loads:
    """Return the processor time of measured runs."""
    loads: dict[str, dict[Cell, Array]] = {AGENT: {}, TEAM: {}}
    for index, point in enumerate(timed.experiment.points):
        own = [(case, result) for case, result in zip(timed.cases, timed.results, strict=True) if case.point == index]
        cell = Cell(*list(point.labels.values())[1:])  # type: ignore[arg-type]
        steps_ms = np.array([result.numbers["cpu_step_p50_ms"] for _, result in own], dtype=float)
        loads[AGENT][cell] = steps_ms / 1e3 / cell.period_s
        loads[TEAM][cell] = len(own[0][0].scenario.owned) * loads[AGENT][cell]
    return loads


def equal_periods(cells: Sequence[Cell], loads: Mapping[Cell, Array], reference: Cell) -> tuple[float, float]:
    """Return the range of periods at which a controller computes as much as the reference, over all repetitions, s.

    The low end is 0 if a repetition computes less even at the shortest measured period; the high end is infinite if one
    computes more even at the longest. Between two periods the ratio is interpolated as a power of the period: exact for
    a constant step time, and close for a growing horizon. The cells are those of one controller, from the longest
    period to the shortest.
    """
    periods = np.log([cell.period_s for cell in cells])
    equal_s = []
    for ratios in np.log([loads[cell] / loads[reference] for cell in cells]).T:
        more = np.flatnonzero(ratios >= 0.0)
        if ratios[0] > 0.0:
            equal_s.append(math.inf)
        elif not len(more):
            equal_s.append(0.0)
        else:
            pair = slice(max(0, more[0] - 1), more[0] + 1)
            equal_s.append(math.exp(np.interp(0.0, ratios[pair], periods[pair])))
    return min(equal_s), max(equal_s)


def cost_curves(
    cells: Mapping[tuple[str, str], Sequence[Cell]], swept: Swept, loads: Loads, reference: Cell
) -> list[Curve]:
    """Return the curves in each weather, each run relative to the reference's with the same seed.

    Raises: ExperimentError: a run raised an error, or the reference diverged.
    """
    swept.check()
    means = {tuple(m.point.labels.values()): m for m in swept.measured}
    weathers = list(dict.fromkeys(str(weather) for weather, *_ in means))
    ratios = {name: _by_point(swept, name) for name in ("cost_mean", "cost_max")}
    for found in ratios.values():
        first = {weather: found[weather, *reference] for weather in weathers}
        if not all(np.isfinite(own).all() and own.all() for own in first.values()):
            raise ExperimentError(f"{NAME}: expected a centralized controller that completes, got one that does not")
        found |= {labels: costs / first[labels[0]] for labels, costs in found.items()}

    def row(kept: str, labels: tuple[Any, ...]) -> Row:
        own = {name: value for name, value in means[labels].row().items() if name not in ("scenario", COST_RATIO)}
        for name, found in ratios.items():
            mean = estimate(list(found[labels][np.isfinite(found[labels])]))
            own |= {f"{name}_ratio": mean and mean.mean, f"{name}_ratio_ci95": mean and mean.half_width}
        cell = Cell(*labels[1:])
        agent_s = loads[AGENT][cell]
        times = {"step_ms": 1e3 * cell.period_s * agent_s, "agent_s_per_s": agent_s, "team_s_per_s": loads[TEAM][cell]}
        for name, values in times.items():
            own |= {f"cpu_{name}{end}": float(np.quantile(values, share)) for end, share in _ENDS.items()}
        return {"kept": kept, **own}

    return [
        Curve(
            weather,
            controller,
            kept,
            own,
            [row(kept, (weather, *cell)) for cell in own],
            np.array([ratios["cost_mean"][weather, *cell] for cell in own]),
        )
        for weather in weathers
        for (controller, kept), own in cells.items()
    ]


# Columns of processor time: median, smallest and largest repetition.
_ENDS = {"": 0.5, "_min": 0.0, "_max": 1.0}


def _by_point(swept: Swept, name: str) -> dict[tuple[Any, ...], Array]:
    """Return a number of the runs of each point, by its labels; infinite for a diverged run."""
    found: dict[tuple[Any, ...], list[float]] = {}
    for case, result in zip(swept.cases, swept.results, strict=True):
        value = result.numbers[name] if result.outcome == "completed" else None
        labels = swept.experiment.points[case.point].labels
        found.setdefault(tuple(labels.values()), []).append(math.inf if value is None else value)
    return {labels: np.array(values) for labels, values in found.items()}


def grade(ratio: float) -> str:
    """Return one of `GRADES` for a mean cost over the centralized controller's; infinite for diverged runs."""
    if math.isinf(ratio):
        return "diverged"
    share = round(abs(ratio - 1.0), 9)  # as 1.1 - 1 is above 0.1 in binary
    if share <= _EQUAL:
        return "equal"
    how = "slightly " if share <= _SLIGHT else "" if share <= _MUCH else "much "
    return how + ("worse" if ratio > 1.0 else "better")


def verdicts(curves: Sequence[Curve], loads: Loads, reference: Cell) -> Iterator[Row]:
    """Yield a row of verdict.csv for each distributed curve, at the same rate and at the same computation.

    An end of the periods beyond the grid is empty, the ratio of a diverged run infinite.
    """
    at_the_rate = set()  # both horizons are equal there
    for curve in (curve for curve in curves if curve.controller != CENTRALIZED):
        # The processor time of diverging runs is not representative.
        own = [cell for cell, costs in zip(curve.cells, curve.costs, strict=True) if np.isfinite(costs).all()]
        ranges = {budget: equal_periods(own, loads[budget], reference) if own else None for budget in (TEAM, AGENT)}
        if (curve.weather, curve.controller) not in at_the_rate:
            at_the_rate.add((curve.weather, curve.controller))
            ranges = {SAME_RATE: (reference.period_s, reference.period_s), **ranges}
        for budget, periods_s in ranges.items():
            low_s, high_s = periods_s or (curve.periods_s[-1], curve.periods_s[0])
            ratios = curve.cost_range(low_s, high_s) if own else (math.inf, math.inf)
            row: Row = {"weather": curve.weather, "controller": curve.controller, "budget": budget, "kept": curve.kept}
            row["period_low_s"], row["period_high_s"] = (s if 0.0 < s < math.inf else None for s in (low_s, high_s))
            row["cost_ratio_low"], row["cost_ratio_high"] = ratios or (None, None)
            row["verdict"] = row["claim"] = row["supported"] = ""
            if ratios is None:
                row["verdict"] = _MORE if low_s else _LESS
            else:
                row["verdict"] = " to ".join(dict.fromkeys(grade(ratio) for ratio in ratios))
            if curve.controller == PAPER:
                row["claim"] = "slightly worse" if budget == SAME_RATE else "slightly better"
                row["supported"] = _supported(row)
            yield row


def _supported(row: Row) -> str:
    """Return whether the claim of a verdict holds: undetermined if the verdict covers other grades as well."""
    if row["cost_ratio_low"] is None:
        return "does not apply"
    best, worst = (GRADES.index(grade(row[f"cost_ratio_{end}"])) for end in ("low", "high"))
    is_open = row["period_low_s"] is None or row["period_high_s"] is None
    if not best <= GRADES.index(row["claim"]) <= worst:
        return "undetermined" if is_open else "does not hold"
    return "holds" if best == worst and not is_open else "undetermined"


def sentences(rows: Sequence[Row]) -> Iterator[str]:
    """Yield a sentence for each verdict, with the paper's claim."""
    for row in rows:
        same = row["budget"]
        if same != SAME_RATE:
            same = f"same computation of {'the ' * (same == TEAM)}{same}, as many {row['kept']} of horizon"
        ratios = dict.fromkeys(f"x{row[f'cost_ratio_{end}'] or 0.0:.2f}" for end in ("low", "high"))
        cost = " to ".join(ratios).replace("xinf", "diverged")
        where = "" if row["verdict"] in (_MORE, _LESS) else f"T_s {_periods(row)}, cost {cost}: "
        claim = f' ("{row["claim"]}" {row["supported"]})' if row["claim"] else ""
        yield f"{row['weather']}, {row['controller']}, {same}: {where}{row['verdict']}{claim}"


def _periods(row: Row) -> str:
    """Return the sampling periods of a verdict, ms; an end beyond the grid is left open."""
    low, high = (end and f"{1e3 * end:.3g}" for end in (row["period_low_s"], row["period_high_s"]))
    if low and high:
        return f"{low} ms" if low == high else f"{low} to {high} ms"
    return f"{low} ms and more" if low else f"up to {high} ms"
