"""Verdicts of the comparison: grades that follow from ranges of cost ratios alone."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from transport.experiments.comparison import (
    AGENT,
    CENTRALIZED,
    PAPER,
    STEPS,
    TEAM,
    Cell,
    Loads,
    PeriodRange,
    equal_periods,
)
from transport.experiments.cost_curves import Curve

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
