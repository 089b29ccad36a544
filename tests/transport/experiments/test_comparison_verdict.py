"""Verdicts: every grade, ranges that cover several grades, and the paper's statements."""

import math

import pytest

from transport.experiments.comparison import (
    PAPER,
    STEPS,
    STILL,
    PeriodRange,
)
from transport.experiments.comparison_verdict import (
    FAILS,
    GRADES,
    HOLDS,
    SAME_RATE,
    Verdict,
    grade,
)

RATIOS = {
    "much better": 0.4,
    "better": 0.7,
    "slightly better": 0.95,
    "equal": 1.0,
    "slightly worse": 1.05,
    "worse": 1.3,
    "much worse": 1.98,
    "diverged": math.inf,
}

AT_REFERENCE = PeriodRange(0.05, 0.05)


def made(
    low: float | None,
    high: float | None = None,
    *,
    budget: str = SAME_RATE,
    weather: str = STILL,
    kept: str = STEPS,
    periods: PeriodRange = AT_REFERENCE,
) -> Verdict:
    """A verdict on the paper's algorithm from a range of ratios."""
    ratios = None if low is None else (low, low if high is None else high)
    return Verdict(controller=PAPER, weather=weather, budget=budget, kept=kept, periods=periods, ratios=ratios)


@pytest.mark.parametrize("expected", GRADES)
@pytest.mark.parametrize("claim", ["slightly worse", "slightly better"])
def test_each_verdict_supports_its_own_claim_alone(claim: str, expected: str) -> None:
    """Each grade follows from its ratio; "much worse" is not "slightly worse", nor is "better" "slightly better"."""
    assert grade(RATIOS[expected]) == expected
    assert made(RATIOS[expected]).text == expected
    assert made(RATIOS[expected]).supports(claim) == (HOLDS if expected == claim else FAILS)
