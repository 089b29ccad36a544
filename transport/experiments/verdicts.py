"""Verdicts of the comparison: cost at the same rate and at the same computation as the reference.

Grades follow from ranges of cost ratios alone.
"""

import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence

import numpy as np

from transport.experiments.comparison import (
    CENTRALIZED,
    PAPER,
    SECONDS,
    Cell,
    Curve,
    Row,
    equal_periods,
)

# A verdict holds equal the rate, or the computation of a budget.
SAME_RATE = "the same rate"

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

# Claims of the paper about its algorithm.
_CLAIM_AT_RATE = "slightly worse"
_CLAIM_AT_COMPUTATION = "slightly better"

Range = tuple[float, float]


def grade(ratio: float) -> str:
    """Return one of `GRADES` for a mean cost over the centralized controller's.

    The ratio is infinite for diverged runs.
    """
    difference = round(ratio - 1.0, 9)  # as 1.1 - 1 is above 0.1 in binary
    return GRADES[bisect_left(_UP_TO, difference)]


def verdicts(curves: Sequence[Curve], reference: Cell) -> Iterator[Row]:
    """Yield the rows of verdict.csv: each distributed curve at the same rate and computation.

    An end of the periods beyond the grid is empty, the ratio of a diverged run infinite.
    """
    whole = curves[0]
    place = whole.cells.index(reference)
    reference_loads = {budget: loads[place] for budget, loads in whole.loads.items()}

    for curve in curves:
        if curve.controller == CENTRALIZED:
            continue
        if curve.kept == SECONDS:
            yield _verdict(curve, SAME_RATE, (reference.period_s, reference.period_s))

        # The processor time of diverging runs is not representative.
        completed = np.flatnonzero(np.isfinite(curve.ratios).all(axis=1))
        periods_s = np.array([cell.period_s for cell in curve.cells])[completed]
        for budget, loads in curve.loads.items():
            range_s = (0.0, math.inf)
            if len(periods_s):
                range_s = equal_periods(periods_s, loads[completed] / reference_loads[budget])
            yield _verdict(curve, budget, range_s)


def sentence(row: Row) -> str:
    """Return a verdict in words, with the paper's claim."""
    where = f"T_s {row['T_s']}, cost {row['cost']}: " if row["cost"] else ""
    claim = f' ("{row["claim"]}" {row["supported"]})' if row["claim"] else ""
    return f"{row['weather']}, {row['controller']}, at {row['at']}: {where}{row['verdict']}{claim}"


def _verdict(curve: Curve, budget: str, range_s: Range) -> Row:
    """Return the row of a curve over the periods at which it computes as much as the reference."""
    ratios = curve.cost_range(*range_s)
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
        row["verdict"] = f"computes {'more' if range_s[0] else 'less'} wherever it completes"
    else:
        row["T_s"] = _periods_in_words(range_s)
        row["cost"] = _joined(f"x{ratio:.2f}" for ratio in ratios).replace("xinf", "diverged")
        row["verdict"] = _joined(grade(ratio) for ratio in ratios)

    row["claim"] = row["supported"] = ""
    if curve.controller == PAPER:
        row["claim"] = _CLAIM_AT_RATE if budget == SAME_RATE else _CLAIM_AT_COMPUTATION
        row["supported"] = _support(row["claim"], range_s, ratios)
    return row


def _support(claim: str, range_s: Range, ratios: Range | None) -> str:
    """Return whether a claim holds at all cost ratios of a range of periods within the grid."""
    if ratios is None:
        return "does not apply"
    if not all(0.0 < end_s < math.inf for end_s in range_s):
        return "undetermined"

    best, worst = (GRADES.index(grade(ratio)) for ratio in ratios)
    if not best <= GRADES.index(claim) <= worst:
        return "does not hold"
    return "holds" if best == worst else "undetermined"


def _periods_in_words(range_s: Range) -> str:
    """Return a range of periods, whose ends may lie beyond the grid."""
    low_s, high_s = range_s
    low = f"{1e3 * low_s:.3g} ms" if 0.0 < low_s < math.inf else "shorter than the grid"
    high = f"{1e3 * high_s:.3g} ms" if 0.0 < high_s < math.inf else "longer than the grid"
    return _joined([low, high])


def _joined(ends: Iterator[str] | Sequence[str]) -> str:
    """Return a range in words; equal ends are one value."""
    return " to ".join(dict.fromkeys(ends))
