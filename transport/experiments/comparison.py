"""Comparison of centralized and distributed control: processor time and cost at a grid of periods, and the verdicts.

A curve is the mean cost over the sampling period, relative to the centralized controller; grades follow from ranges of
cost ratios alone.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import orjson
import threadpoolctl

from model.arrays import Array
from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.setup import Setup
from protocol.wire.messages import Message, StepReport
from transport.experiments.cases import ExperimentError, Point, refused
from transport.experiments.declaration import QUICK_MANEUVER, Declaration, Experiment, axis
from transport.experiments.simulation import NUMBERS
from transport.experiments.statistics import COST_RATIO, estimate
from transport.experiments.sweep import Swept
from transport.flight import memory
from transport.report.report import write_whole

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

# Repetitions of a measurement, and first ticks of each run that are not counted: caches and solvers warm up. Its
# maneuver is long enough to settle, short enough that both runs of a pair see the same machine.
_REPEATS, _QUICK_REPEATS, _WARM_UP = 5, 1, 3
MANEUVER = QUICK_MANEUVER
_QUICK_MEASUREMENT = "maneuver.phase=[{name='climb',duration_s=0.4,displacement_m=[0,0,-0.2]}]"

_COMPUTATION = "computation.json"

# Relative differences of the mean cost: up to the first equal, up to the second slightly, beyond the third much.
_EQUAL, _SLIGHT, _MUCH = 0.005, 0.1, 0.5

# From the best to the worst: a range of ratios covers all grades between its ends.
GRADES = ("much better", "better", "slightly better", "equal", "slightly worse", "worse", "much worse", "diverged")
_MORE, _LESS = "computes more wherever it completes", "computes less wherever it completes"

Row = dict[str, Any]


class Cell(NamedTuple):
    """A controller at one sampling period."""

    controller: str
    period_s: float  # T_s
    horizon: int  # N_p, steps


@dataclass(frozen=True, slots=True)
class Load:
    """Processor time of an agent's step at a cell in each repetition, and of the reference, measured just before."""

    cell: Cell
    agents: int
    step_ms: list[float]
    reference_step_ms: list[float]

    def seconds_per_second(self, budget: str) -> Array:
        """Return processor time of the team or an agent per simulated second in each repetition, s/s."""
        return self._agents(budget) * np.array(self.step_ms) / 1e3 / self.cell.period_s

    def ratios(self, budget: str, reference_s: float) -> Array:
        """Return processor time per simulated second over that of the reference, which has one agent for all."""
        ratios: Array = np.array(self.step_ms) / np.array(self.reference_step_ms)
        return self._agents(budget) * reference_s / self.cell.period_s * ratios

    def _agents(self, budget: str) -> int:
        return self.agents if budget == TEAM else 1


Loads = Mapping[Cell, Load]


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

    def cell(controller: str, kept: str, own_s: float) -> Cell:
        ratio = 1.0 if kept == STEPS else reference.period_s / own_s
        return Cell(controller, own_s, max(1, round(reference.horizon * ratio)))

    return {
        (controller, kept): [
            cell(controller, kept, round(factor * reference.period_s, 6))
            for factor in (QUICK_GRID if quick else GRID)
            if factor >= shortest
        ]
        for (controller, kept), shortest in CURVES.items()
    }


def setup_of(controller: str, settings: Sequence[str]) -> Setup:
    """Return the run of a controller.

    Raises: ScenarioError: wrong settings, or a centralized controller with more than one agent.
    """
    path = find_scenario(SCENARIOS[controller])
    setup = Setup.of(read_scenario(path, settings), str(path))
    if controller == CENTRALIZED and len(setup.agents) > 1:
        raise ScenarioError(str(path), "agents.owned", f"expected one agent that owns all, got {len(setup.agents)}")
    return setup


def at_rate(cell: Cell) -> tuple[str, ...]:
    """Return the settings of a cell: controller, sampling period, horizon, and a plant step of at most one period."""
    law = _CLOSED_LOOP if cell.controller == CLOSED_LOOP else ()
    rate = f"controller.sampling_period_s={cell.period_s!r}", f"controller.horizon={cell.horizon}"
    return (*law, *rate, *([f"plant.step_s={cell.period_s!r}"] if cell.period_s < 0.01 else []))


def experiment(cells: Sequence[Cell], reference: Cell, gust_mps: float) -> Experiment:
    """Return the sweep: every cell in still air and, unless their standard deviation in m/s is zero, in gusts."""
    weathers = {STILL: 0.0, **({GUSTS: gust_mps} if gust_mps > 0.0 else {})}
    points = [
        Point(
            scenario=SCENARIOS[cell.controller],
            labels={"weather": weather, **cell._asdict()},
            text=f"{1e3 * cell.period_s:g} ms x {cell.horizon}, {weather}",
            settings=(*at_rate(cell), f"plant.wind.gust_mps=[{gust!r},{gust!r},{gust!r}]"),
            baseline=cell == reference,
        )
        for weather, gust in weathers.items()
        for cell in cells
    ]
    return Experiment(name=NAME, points=tuple(points), x=axis("period_s"))


# Defaults of the common options; the command has a report of its own.
DECLARED = Declaration(build=lambda: (), options={}, drawn={}, seeds=5)


def step_ms(setup: Setup) -> float:
    """Return the mean processor time of an agent's step in a run, all stages of computation, ms.

    Raises: ValueError: the run ends before the first counted tick.
    """
    times_ms: list[float] = []

    def record(message: Message) -> None:
        if isinstance(message, StepReport) and message.tick >= _WARM_UP:
            times_ms.append(float(message.times_ms[-1]))

    with threadpoolctl.threadpool_limits(1):  # the clock measures this thread only
        control = memory.simulate(setup, record, time.thread_time_ns)
    if not times_ms:
        raise ValueError(f"expected a run of more than {_WARM_UP} ticks, got {control.outcome}: {control.reason}")
    return statistics.fmean(times_ms)


def measure(reference: Setup, candidates: Mapping[Cell, Setup], repeats: int, notify: Callable[[str], None]) -> Loads:
    """Measure all candidates once, then all again, so that a slow period of the machine affects all alike.

    The reference is measured immediately before each, so that both of a ratio see the same machine.
    """
    loads = {cell: Load(cell, len(setup.agents), [], []) for cell, setup in candidates.items()}
    for repetition in range(1, repeats + 1):
        for cell, setup in candidates.items():
            loads[cell].reference_step_ms.append(step_ms(reference))
            loads[cell].step_ms.append(step_ms(setup))
        notify(f"computation of {len(loads)} controllers and periods: repetition {repetition} of {repeats} done")
    return loads


def processor_times(
    folder: Path, settings: Sequence[str], cells: Sequence[Cell], *, quick: bool, notify: Callable[[str], None]
) -> Loads:
    """Return the processor time of every cell, measured once for each folder.

    Raises: ExperimentError: the folder was measured with other settings, or by another version of this package.
    """
    maneuver, repeats = (_QUICK_MEASUREMENT, _QUICK_REPEATS) if quick else (MANEUVER, _REPEATS)
    path, begun_with = folder / _COMPUTATION, [*settings, maneuver]
    if path.exists():
        content = orjson.loads(path.read_bytes())
        if content["settings"] != begun_with:
            raise refused("--set", f"the settings {folder} was begun with, {content['settings']}", begun_with)
        found = {Cell(*load["cell"]): Load(**{**load, "cell": Cell(*load["cell"])}) for load in content["loads"]}
        if list(found) != list(cells):
            raise refused("--out", "a folder of this version of the experiment", f"{folder}, begun with other periods")
        return found
    candidates = {cell: setup_of(cell.controller, [*begun_with, *at_rate(cell)]) for cell in cells}
    loads = measure(setup_of(CENTRALIZED, begun_with), candidates, repeats, notify)
    content = {"settings": begun_with, "loads": [{**asdict(load), "cell": list(load.cell)} for load in loads.values()]}
    write_whole(path, orjson.dumps(content) + b"\n")
    return loads


def equal_periods(loads: Sequence[Load], budget: str, reference_s: float) -> tuple[float, float]:
    """Return the range of periods at which a controller computes as much as the reference, over all repetitions, s.

    The low end is 0 if a repetition computes less even at the shortest measured period; the high end is infinite if one
    computes more even at the longest. Between two periods the ratio is interpolated as a power of the period: exact for
    a constant step time, and close for a growing horizon.

    Args:
        loads: Loads of one controller, from the longest period to the shortest.
        budget: `TEAM` or `AGENT`.
        reference_s: Sampling period of the reference.
    """
    periods = np.log([load.cell.period_s for load in loads])
    equal_s = []
    for ratios in np.log([load.ratios(budget, reference_s) for load in loads]).T:
        more = np.flatnonzero(ratios >= 0.0)
        if ratios[0] > 0.0:
            equal_s.append(math.inf)
        elif not len(more):
            equal_s.append(0.0)
        else:
            pair = slice(max(0, more[0] - 1), more[0] + 1)
            equal_s.append(math.exp(np.interp(0.0, ratios[pair], periods[pair])))
    return min(equal_s), max(equal_s)


def cost_curves(cells: Mapping[tuple[str, str], Sequence[Cell]], swept: Swept, loads: Loads) -> list[Curve]:
    """Return the curves in each weather, each run relative to the reference's with the same seed.

    Raises: ExperimentError: a run raised an error, or the reference diverged.
    """
    swept.check()
    points = swept.experiment.points
    completed: list[dict[int, Mapping[str, float | None]]] = [{} for _ in points]
    for case, result in zip(swept.cases, swept.results, strict=True):
        completed[case.point][case.scenario.seed] = result.numbers if result.outcome == "completed" else {}
    rows: dict[tuple[Any, ...], Row] = {}
    costs: dict[tuple[Any, ...], list[float]] = {}
    reference: dict[Any, dict[int, Mapping[str, float | None]]] = {}
    for m, runs in zip(swept.measured, completed, strict=True):
        if m.point.baseline:
            reference[m.point.labels["weather"]] = runs
            if m.completed < m.runs or m.mean("cost_mean") == 0.0:
                got = f"one that diverges at {m.diverged_s[0]:.1f} s" if m.diverged_s else "one without a cost"
                raise ExperimentError(f"{NAME}: expected a centralized controller to compare with, got {got}")
    for m, runs in zip(swept.measured, completed, strict=True):
        weather, *cell = m.point.labels.values()
        first = reference[weather]
        ratios = {
            name: {
                seed: value / other
                for seed, numbers in runs.items()
                if (value := numbers.get(name)) is not None and (other := first[seed].get(name))
            }
            for name in NUMBERS[1:]
        }
        row = {name: value for name, value in m.row().items() if name not in ("scenario", "errors", COST_RATIO)}
        for name, found in ratios.items():
            mean = estimate(list(found.values()))
            row |= {f"{name}_ratio": mean and mean.mean, f"{name}_ratio_ci95": mean and mean.half_width}
        rows[weather, *cell] = row | _times(loads[Cell(*cell)])  # type: ignore[arg-type]
        costs[weather, *cell] = [ratios["cost_mean"].get(seed, math.inf) for seed in runs]
    return [
        Curve(weather, controller, kept, own, [{"kept": kept, **rows[weather, *cell]} for cell in own], found)
        for weather, ((controller, kept), own) in product(reference, cells.items())
        for found in [np.array([costs[weather, *cell] for cell in own])]
    ]


def _times(load: Load) -> Row:
    """Return median, smallest and largest processor time as columns of curves.csv."""
    values = {
        "cpu_step_ms": np.array(load.step_ms),
        "cpu_agent_s_per_s": load.seconds_per_second(AGENT),
        "cpu_team_s_per_s": load.seconds_per_second(TEAM),
    }
    ends = {"": 0.5, "_min": 0.0, "_max": 1.0}
    return {f"{name}{end}": float(np.quantile(own, q)) for name, own in values.items() for end, q in ends.items()}


def grade(ratio: float) -> str:
    """Return one of `GRADES` for a mean cost over the centralized controller's; infinite for diverged runs."""
    if math.isinf(ratio):
        return "diverged"
    share = round(abs(ratio - 1.0), 9)  # as 1.1 - 1 is above 0.1 in binary
    if share <= _EQUAL:
        return "equal"
    how = "slightly " if share <= _SLIGHT else "" if share <= _MUCH else "much "
    return how + ("worse" if ratio > 1.0 else "better")


def verdicts(curves: Sequence[Curve], loads: Loads, reference: Cell) -> list[Row]:
    """Return a row of verdict.csv for each distributed curve, at the same rate and at the same computation.

    An end of the periods beyond the grid is empty, the ratio of a diverged run infinite.
    """
    found: list[Row] = []
    for curve in curves:
        if curve.controller == CENTRALIZED:
            continue
        # The processor time of diverging runs is not representative.
        own = [loads[cell] for cell, costs in zip(curve.cells, curve.costs, strict=True) if np.isfinite(costs).all()]
        ranges = {SAME_RATE: (reference.period_s, reference.period_s)}
        if (curve.weather, curve.controller) in {(row["weather"], row["controller"]) for row in found}:
            ranges = {}  # both horizons are equal there
        for budget in (TEAM, AGENT):
            every = (curve.periods_s[-1], curve.periods_s[0])
            ranges[budget] = equal_periods(own, budget, reference.period_s) if own else every
        for budget, periods_s in ranges.items():
            ratios = curve.cost_range(*periods_s) if own else (math.inf, math.inf)
            found.append(_verdict(curve, budget, periods_s, ratios))
    return found


def _verdict(curve: Curve, budget: str, periods_s: tuple[float, float], ratios: tuple[float, float] | None) -> Row:
    low_s, high_s = (end if 0.0 < end < math.inf else None for end in periods_s)
    claim = "slightly worse" if budget == SAME_RATE else "slightly better"
    if ratios is None:
        text = supported = {math.inf: _MORE, 0.0: _LESS}[periods_s[0]]
    else:
        best, worst = (GRADES.index(grade(ratio)) for ratio in ratios)
        text = GRADES[best] if best == worst else f"{GRADES[best]} to {GRADES[worst]}"
        is_open = low_s is None or high_s is None
        supported = "undetermined"
        if not best <= GRADES.index(claim) <= worst:
            supported = "undetermined" if is_open else "does not hold"
        elif best == worst and not is_open:
            supported = "holds"
    return {
        "weather": curve.weather,
        "controller": curve.controller,
        "budget": budget,
        "kept": curve.kept,
        "period_low_s": low_s,
        "period_high_s": high_s,
        "cost_ratio_low": ratios and ratios[0],
        "cost_ratio_high": ratios and ratios[1],
        "verdict": text,
        "claim": claim if curve.controller == PAPER else "",
        "supported": supported if curve.controller == PAPER else "",
    }


def sentences(rows: Sequence[Row]) -> Iterator[str]:
    """Yield a sentence for each verdict."""
    for row in rows:
        same = row["budget"] if row["budget"] == SAME_RATE else f"same computation of {_whose(row)}"
        low, high = (f"x{end:.2f}" for end in (row["cost_ratio_low"] or 0.0, row["cost_ratio_high"] or 0.0))
        cost = f", cost {low if low == high else f'{low} to {high}'}".replace("xinf", "diverged")
        where = "" if row["verdict"] in (_MORE, _LESS) else f"T_s {_periods(row)}{cost}: "
        yield f"{row['weather']}, {row['controller']}, {same}: {where}{row['verdict']}"


def _whose(row: Row) -> str:
    """Return the budget and the horizon of a verdict on equal computation."""
    return f"{'the ' * (row['budget'] == TEAM)}{row['budget']}, as many {row['kept']} of horizon"


def _periods(row: Row) -> str:
    """Return the sampling periods of a verdict, ms; an end beyond the grid is left open."""
    low, high = (end and f"{1e3 * end:.3g}" for end in (row["period_low_s"], row["period_high_s"]))
    if low and high:
        return f"{low} ms" if low == high else f"{low} to {high} ms"
    return f"{low} ms and more" if low else f"up to {high} ms" if high else "not determined"


def statements(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the paper's two statements, each with the verdicts on the paper's algorithm in all weathers."""
    own = [row for row in rows if row["controller"] == PAPER]
    for budget, kept in dict.fromkeys((row["budget"], row["kept"]) for row in own):
        found = [row for row in own if (row["budget"], row["kept"]) == (budget, kept)]
        first, supported = found[0], {row["supported"] for row in found}
        if len(supported) > 1:
            result = ", ".join(f"{row['supported']} in {row['weather']} ({row['verdict']})" for row in found)
        elif first["verdict"] == first["supported"]:
            result = first["verdict"]
        else:
            named = ", ".join(f"{row['verdict']} in {row['weather']}" for row in found)
            result = f"{first['supported']} ({named})"
        where = "at the same rate" if budget == SAME_RATE else "at the same computation"
        which = "" if budget == SAME_RATE else f" ({budget}, as many {kept} of horizon)"
        yield f'"{first["claim"]} {where}"{which}: {result}'
