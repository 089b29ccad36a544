"""Cost curves and verdicts of the comparison.

A curve is the mean cost over the sampling period, relative to the centralized controller and interpolated; grades
follow from ranges of cost ratios alone.
"""

import bisect
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from transport.experiments.comparison import (
    AGENT,
    CENTRALIZED,
    PAPER,
    STEPS,
    TEAM,
    Cell,
    Curves,
    Loads,
    PeriodRange,
    equal_periods,
)
from transport.experiments.simulation import NUMBERS
from transport.experiments.statistics import Estimate, estimate
from transport.experiments.sweep import Swept

COST = "cost_mean"

SAME_RATE = "same rate"
BUDGETS = {
    SAME_RATE: "same rate",
    TEAM: "same computation of the whole team",
    AGENT: "same computation of one agent",
}

# Relative differences of the mean cost: up to the first equal, up to the second slightly, beyond the third much.
_EQUAL, _SLIGHT, _MUCH = 0.005, 0.1, 0.5

# From the best to the worst: a range of ratios covers all grades between its ends.
GRADES = ("much better", "better", "slightly better", "equal", "slightly worse", "worse", "much worse", "diverged")

# Verdicts if the same computation is outside all periods at which a controller completes.
_OUTSIDE = {
    PeriodRange(math.inf, math.inf): "computes more wherever it completes",
    PeriodRange(0.0, 0.0): "computes less wherever it completes",
}

HOLDS, FAILS, UNDECIDED = "holds", "does not hold", "undetermined"


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Verdict on a distributed controller against the centralized one, at the same rate or the same computation.

    The ratios are the lowest and highest mean cost over the centralized controller's at the periods; None outside the
    grid.
    """

    controller: str
    weather: str  # still air or gusts
    budget: str  # common quantity: `SAME_RATE`, or the computation of the `TEAM` or of one `AGENT`
    kept: str  # by the horizon: the reference's "steps" or "seconds"
    periods: PeriodRange  # sampling periods of that budget, over the repetitions of the measurement
    ratios: tuple[float, float] | None

    @property
    def text(self) -> str:
        """Both ends of the range, the better first as the lower ratio, or one grade."""
        if self.ratios is None:
            return _OUTSIDE.get(self.periods, "not compared")
        best, worst = (grade(ratio) for ratio in self.ratios)
        return best if best == worst else f"{best} to {worst}"

    def supports(self, claim: str) -> str:
        """Return whether a claimed grade holds, does not hold, or is one of several in the range."""
        if self.ratios is None:
            return self.text
        best, worst = (GRADES.index(grade(ratio)) for ratio in self.ratios)
        if not best <= GRADES.index(claim) <= worst:
            return UNDECIDED if self.periods.is_open else FAILS
        return HOLDS if best == worst and not self.periods.is_open else UNDECIDED


def grade(ratio: float) -> str:
    """Return one of `GRADES` for a mean cost over the centralized controller's; infinite for diverged runs."""
    if math.isinf(ratio):
        return "diverged"
    share = abs(ratio - 1.0)
    if share <= _EQUAL:
        return "equal"
    # Rounded, as 1.1 - 1 is above 0.1 in binary.
    how = "slightly " if round(share, 9) <= _SLIGHT else "" if round(share, 9) <= _MUCH else "much "
    return how + ("worse" if ratio > 1.0 else "better")


def verdicts(curves: Sequence[Curve], loads: Loads, reference: Cell) -> list[Verdict]:
    """Return the verdicts on every distributed curve, at the same rate and at the same computation."""
    found: list[Verdict] = []
    compared = set()
    for curve in curves:
        if curve.controller == CENTRALIZED:
            continue
        # The processor time of diverging runs is not representative.
        own = [loads[node.cell] for node in curve.nodes if node.runs and not node.diverged_s]
        ranges = {SAME_RATE: PeriodRange(reference.period_s, reference.period_s)}
        if (curve.controller, curve.weather) in compared:
            del ranges[SAME_RATE]  # both horizons are equal there
        compared.add((curve.controller, curve.weather))
        if own:
            ranges |= {budget: equal_periods(own, budget) for budget in (TEAM, AGENT)}
        else:
            tried_s = [node.cell.period_s for node in curve.nodes if node.runs]
            ranges |= dict.fromkeys((TEAM, AGENT), PeriodRange(min(tried_s), max(tried_s)))
        found += [
            Verdict(
                controller=curve.controller,
                weather=curve.weather,
                budget=budget,
                kept=curve.kept,
                periods=periods,
                ratios=curve.cost_range(periods) if own else (math.inf, math.inf),
            )
            for budget, periods in ranges.items()
        ]
    return found


def lines(found: Sequence[Verdict]) -> Iterator[str]:
    """Yield a sentence for each verdict."""
    for verdict in found:
        kept = "" if verdict.budget == SAME_RATE else f", as many {verdict.kept} of horizon"
        comparison = f"{verdict.weather}, {verdict.controller}, {BUDGETS[verdict.budget]}{kept}"
        cost = "" if verdict.ratios is None else f", cost {ratios_text(verdict.ratios)}"
        where = "" if verdict.periods in _OUTSIDE else f"T_s {periods_text(verdict.periods)}{cost}: "
        yield f"{comparison}: {where}{verdict.text}"


def statements(found: Sequence[Verdict]) -> list[str]:
    """Return the paper's two statements, each with the verdicts on the paper's algorithm."""
    own = [verdict for verdict in found if verdict.controller == PAPER]
    readings = [("slightly worse", "at the same rate", SAME_RATE, STEPS)]
    for budget, kept in dict.fromkeys((verdict.budget, verdict.kept) for verdict in own):
        if budget != SAME_RATE:
            readings.append(("slightly better", "at the same computation", budget, kept))
    return [
        _statement(claim, where, [verdict for verdict in own if (verdict.budget, verdict.kept) == (budget, kept)])
        for claim, where, budget, kept in readings
    ]


def _statement(claim: str, where: str, found: Sequence[Verdict]) -> str:
    first = found[0]
    which = "" if first.budget == SAME_RATE else f" ({first.budget}, as many {first.kept} of horizon)"
    supports = [verdict.supports(claim) for verdict in found]
    if len(set(supports)) > 1:
        parts = zip(supports, found, strict=True)
        result = ", ".join(f"{how} in {verdict.weather} ({verdict.text})" for how, verdict in parts)
    elif first.ratios is None:
        result = supports[0]
    else:
        result = f"{supports[0]} ({', '.join(f'{verdict.text} in {verdict.weather}' for verdict in found)})"
    return f'"{claim} {where}"{which}: {result}'


def periods_text(periods: PeriodRange) -> str:
    """Return a range of periods in ms; an end beyond the grid is left open."""
    if periods.low_s == periods.high_s and not periods.is_open:
        return f"{1e3 * periods.low_s:.3g} ms"
    if periods.low_s == 0.0 and math.isinf(periods.high_s):
        return "not determined"
    if periods.low_s == 0.0:
        return f"up to {1e3 * periods.high_s:.3g} ms"
    if math.isinf(periods.high_s):
        return f"{1e3 * periods.low_s:.3g} ms and more"
    return f"{1e3 * periods.low_s:.3g} to {1e3 * periods.high_s:.3g} ms"


def ratios_text(ratios: tuple[float, float]) -> str:
    """Return a range of cost ratios as text."""
    low, high = (f"x{ratio:.2f}" if math.isfinite(ratio) else "diverged" for ratio in ratios)
    return low if low == high else f"{low} to {high}"
