"""Verdicts: every grade, ranges that cover several grades, and the paper's statements."""

import math

import pytest

from transport.experiments.comparison import (
    AGENT,
    CENTRALIZED,
    PAPER,
    SECONDS,
    STEPS,
    STILL,
    TEAM,
    Cell,
    Load,
    PeriodRange,
)
from transport.experiments.comparison_verdict import (
    COST,
    FAILS,
    GRADES,
    HOLDS,
    SAME_RATE,
    Curve,
    Node,
    Verdict,
    grade,
    lines,
    verdicts,
)
from transport.experiments.statistics import estimate

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


def curve(controller: str, kept: str, costs: dict[float, float]) -> Curve:
    """A cost curve in still air from ratios by period; an infinite one is a run that diverged."""
    nodes = [
        Node(
            cell=Cell(controller=controller, period_s=period_s, horizon=20),
            runs=1,
            diverged_s=() if math.isfinite(ratio) else (3.5,),
            numbers={COST: estimate([ratio])},
            ratios={COST: {0: ratio}} if math.isfinite(ratio) else {},
        )
        for period_s, ratio in costs.items()
    ]
    return Curve(controller=controller, kept=kept, weather=STILL, nodes=tuple(nodes))


REFERENCE = Cell(controller=CENTRALIZED, period_s=0.05, horizon=20)


def measured(*periods_s: float) -> dict[Cell, Load]:
    """Two repetitions of the processor time of both controllers: 8 ms a step, and 4 or 5 ms for each agent."""
    return {
        Cell(controller=controller, period_s=period_s, horizon=20): Load(
            controller=controller,
            period_s=period_s,
            horizon=20,
            agents=1 if controller == CENTRALIZED else 4,
            reference_period_s=0.05,
            step_ms=[8.0, 8.0] if controller == CENTRALIZED else [4.0, 5.0],
            reference_step_ms=[8.0, 8.0],
        )
        for controller in (CENTRALIZED, PAPER)
        for period_s in periods_s
    }


def test_verdicts_follow_from_curves_and_loads() -> None:
    """The spread of processor times becomes a spread of periods and, by the cost curve, of the verdict."""
    costs = {0.1: 4.0, 0.05: 1.3, 0.025: 0.9}
    curves = [curve(CENTRALIZED, STEPS, dict.fromkeys(costs, 1.0)), curve(PAPER, STEPS, costs)]
    curves.append(curve(PAPER, SECONDS, costs))
    found = verdicts(curves, measured(*costs), REFERENCE)
    assert [(verdict.budget, verdict.kept) for verdict in found] == [
        (SAME_RATE, STEPS),
        (TEAM, STEPS),
        (AGENT, STEPS),
        (TEAM, SECONDS),
        (AGENT, SECONDS),
    ]
    same_rate, team, agent, *_ = found
    assert (same_rate.text, same_rate.ratios) == ("worse", (1.3, 1.3))
    # 4 x 4 ms in 100 ms are as much as 8 ms in 50 ms, 4 x 5 ms are more.
    assert team.periods.low_s == pytest.approx(0.1)
    assert math.isinf(team.periods.high_s)
    assert (agent.periods.low_s, agent.periods.high_s) == pytest.approx((0.025, 0.03125))
    assert agent.text == "slightly better to slightly worse"
    assert list(lines(found))[2] == (
        "still air, paper's algorithm, same computation of one agent, as many steps of horizon: "
        "T_s 25 to 31.2 ms, cost x0.90 to x1.01: slightly better to slightly worse"
    )
