"""The verdict of the paper's comparison: words that follow from intervals of cost ratios and from nothing else."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from transport.experiments.claim import CENTRALIZED, PAPER, STEPS, Cell
from transport.experiments.computation import AGENT, TEAM, Load, Span, equal_periods
from transport.experiments.cost_curves import Curve

SAME_RATE = "same rate"
BUDGETS = {
    SAME_RATE: "same rate",
    TEAM: "same computation of the whole team",
    AGENT: "same computation of one agent",
}

# Difference of the mean cost up to which controllers are equal, up to which one is slightly better or worse, and beyond
# which it is much.
_EQUAL, _SLIGHT, _MUCH = 0.005, 0.1, 0.5

# From the best to the worst: a range of ratios covers all words between its ends.
WORDS = (
    "much better",
    "better",
    "slightly better",
    "equal",
    "slightly worse",
    "worse",
    "much worse",
    "diverged",
)

# Verdicts where the same computation lies beyond all periods at which a controller completes.
_OUTSIDE = {
    Span(math.inf, math.inf): "computes more wherever it completes",
    Span(0.0, 0.0): "computes less wherever it completes",
}

HOLDS, FAILS, UNDECIDED = "holds", "does not hold", "cannot be told"


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """A distributed controller against the centralized one, at the same rate or at the same computation.

    Attributes:
        controller: Name of the distributed controller.
        weather: Still air or gusts.
        budget: What both have in common: `SAME_RATE`, or the computation of the `TEAM` or of one `AGENT`.
        kept: Whether the horizon keeps the reference's "steps" or "seconds".
        periods: Sampling periods at which that is so, over the repetitions of the measurement.
        ratios: Lowest and highest mean cost over the centralized controller's at these periods; None if no period
            of the grid is there.
    """

    controller: str
    weather: str
    budget: str
    kept: str
    periods: Span
    ratios: tuple[float, float] | None

    @property
    def words(self) -> str:
        """The verdict: both ends of the range, the worse first, where they differ."""
        if self.ratios is None:
            return _OUTSIDE.get(self.periods, "not compared")
        best, worst = (word(ratio) for ratio in self.ratios)
        return best if best == worst else f"{worst} to {best}"

    def supports(self, claim: str) -> str:
        """Whether the claim, one of `WORDS`, holds, does not, or lies within the range beside other words."""
        if self.ratios is None:
            return self.words
        best, worst = (WORDS.index(word(ratio)) for ratio in self.ratios)
        if not best <= WORDS.index(claim) <= worst:
            return UNDECIDED if self.periods.is_open else FAILS
        return HOLDS if best == worst and not self.periods.is_open else UNDECIDED


def word(ratio: float) -> str:
    """One of `WORDS` for a mean cost over the centralized controller's; infinite where runs diverged."""
    if math.isinf(ratio):
        return "diverged"
    share = abs(ratio - 1.0)
    if share <= _EQUAL:
        return "equal"
    # Rounded: 1.1 is 10 % more, though its difference to 1 is above 0.1 in binary.
    how = "slightly " if round(share, 9) <= _SLIGHT else "" if round(share, 9) <= _MUCH else "much "
    return how + ("worse" if ratio > 1.0 else "better")


def verdicts(curves: Sequence[Curve], loads: Sequence[Load], reference: Cell) -> list[Verdict]:
    """Every distributed curve at the reference's rate, and where the team or an agent computes as much.

    Args:
        curves: Cost curves of all controllers.
        loads: Processor time of every cell.
        reference: The centralized cell.
    """
    by_cell = {(load.controller, load.period_s, load.horizon): load for load in loads}
    found = []
    told = set()
    for curve in curves:
        if curve.controller == CENTRALIZED:
            continue
        # A diverging team computes something else: its processor time says nothing of a longer or shorter period.
        cells = [node.cell for node in curve.nodes if node.flights and not node.lost_s]
        own = [by_cell[cell.controller, cell.period_s, cell.horizon] for cell in cells]
        spans = {SAME_RATE: Span(reference.period_s, reference.period_s)}
        if (curve.controller, curve.weather) in told:
            del spans[SAME_RATE]  # both horizons are the same there
        told.add((curve.controller, curve.weather))
        if own:
            spans |= {budget: equal_periods(own, budget) for budget in (TEAM, AGENT)}
        else:
            tried_s = [node.cell.period_s for node in curve.nodes if node.flights]
            spans |= dict.fromkeys((TEAM, AGENT), Span(min(tried_s), max(tried_s)))
        found += [
            Verdict(
                controller=curve.controller,
                weather=curve.weather,
                budget=budget,
                kept=curve.kept,
                periods=span,
                ratios=curve.cost_range(span) if own else (math.inf, math.inf),
            )
            for budget, span in spans.items()
        ]
    return found


def lines(found: Sequence[Verdict]) -> Iterator[str]:
    """A sentence for each verdict."""
    for verdict in found:
        kept = "" if verdict.budget == SAME_RATE else f", as many {verdict.kept} of horizon"
        who = f"{verdict.weather}, {verdict.controller}, {BUDGETS[verdict.budget]}{kept}"
        cost = "" if verdict.ratios is None else f", cost {ratios_text(verdict.ratios)}"
        where = "" if verdict.periods in _OUTSIDE else f"T_s {periods_text(verdict.periods)}{cost}: "
        yield f"{who}: {where}{verdict.words}"


def statements(found: Sequence[Verdict]) -> list[str]:
    """The paper's two statements, each against the verdicts on the paper's algorithm that it is about."""
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
    if first.ratios is None and len(set(supports)) == 1:
        told = supports[0]
    elif len(set(supports)) == 1:
        told = f"{supports[0]} ({', '.join(f'{verdict.words} in {verdict.weather}' for verdict in found)})"
    else:
        parts = zip(supports, found, strict=True)
        told = ", ".join(f"{how} in {verdict.weather} ({verdict.words})" for how, verdict in parts)
    return f'"{claim} {where}"{which}: {told}'


def periods_text(span: Span) -> str:
    """An interval of periods in ms; an end beyond the grid is left open."""
    if span.low_s == span.high_s and not span.is_open:
        return f"{1e3 * span.low_s:.3g} ms"
    if span.low_s == 0.0 and math.isinf(span.high_s):
        return "not determined"
    if span.low_s == 0.0:
        return f"up to {1e3 * span.high_s:.3g} ms"
    if math.isinf(span.high_s):
        return f"{1e3 * span.low_s:.3g} ms and more"
    return f"{1e3 * span.low_s:.3g} to {1e3 * span.high_s:.3g} ms"


def ratios_text(ratios: tuple[float, float]) -> str:
    """A range of cost ratios."""
    low, high = (f"x{ratio:.2f}" if math.isfinite(ratio) else "diverged" for ratio in ratios)
    return low if low == high else f"{low} to {high}"
