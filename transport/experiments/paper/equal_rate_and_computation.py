"""Cost of each distributed curve at the same rate and at the same computation as the reference, as ranges."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from transport.experiments.paper.comparison_curves import ComparisonCurve, equal_periods
from transport.experiments.paper.controllers_and_periods import CENTRALIZED, SECONDS, Cell, Row

# Equal is the rate, or the computation of a budget.
SAME_RATE = "the same rate"

Range = tuple[float, float]


def ranges(curves: Sequence[ComparisonCurve], reference: Cell) -> Iterator[Row]:
    """Yield the rows of ranges.csv: each distributed curve at the same rate and computation.

    An end of the periods beyond the grid is empty, the ratio of a diverged run infinite.
    """
    whole = curves[0]
    place = whole.cells.index(reference)
    reference_loads = {budget: loads[place] for budget, loads in whole.loads.items()}

    for curve in curves:
        if curve.controller == CENTRALIZED:
            continue
        if curve.kept == SECONDS:
            yield _row(curve, SAME_RATE, (reference.period_s, reference.period_s))

        # The processor time of diverging runs is not representative.
        completed = np.flatnonzero(np.isfinite(curve.ratios).all(axis=1))
        periods_s = np.array([cell.period_s for cell in curve.cells])[completed]
        for budget, loads in curve.loads.items():
            range_s = (0.0, math.inf)
            if len(periods_s):
                range_s = equal_periods(periods_s, loads[completed] / reference_loads[budget])
            equal = f"the same computation of {budget}, as many {curve.kept} of horizon"
            yield _row(curve, equal, range_s)


def sentence(row: Row) -> str:
    """Return a row in words."""
    numbers = f"T_s {row['T_s']}, cost {row['cost']}" if row["cost"] else row["T_s"]
    return f"{row['weather']}, {row['controller']}, at {row['at']}: {numbers}"


def _row(curve: ComparisonCurve, equal: str, range_s: Range) -> Row:
    """Return the row of a curve over the periods at which rate or computation equals the reference's."""
    ratios = curve.cost_range(*range_s)
    row: Row = {"weather": curve.weather, "controller": curve.controller, "at": equal}
    if ratios is None:
        row["T_s"] = f"computes {'more' if range_s[0] else 'less'} wherever it completes"
        row["cost"] = ""
    else:
        row["T_s"] = _periods_in_words(range_s)
        row["cost"] = _joined(f"x{ratio:.2f}" for ratio in ratios).replace("xinf", "diverged")
    return row


def _periods_in_words(range_s: Range) -> str:
    """Return a range of periods, whose ends may lie beyond the grid."""
    low_s, high_s = range_s
    low = f"{1e3 * low_s:.3g} ms" if 0.0 < low_s < math.inf else "shorter than the grid"
    high = f"{1e3 * high_s:.3g} ms" if 0.0 < high_s < math.inf else "longer than the grid"
    return _joined([low, high])


def _joined(ends: Iterator[str] | Sequence[str]) -> str:
    """Return a range in words; equal ends are one value."""
    return " to ".join(dict.fromkeys(ends))
