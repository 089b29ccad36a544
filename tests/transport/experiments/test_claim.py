"""The paper's comparison: rates of equal computation, ratios seed by seed, and words that follow from the numbers."""

import csv
import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from protocol.setup import Setup
from tests.runs import ticks
from tests.transport.experiments.flown import here
from transport.experiments import claim
from transport.experiments.cases import Case, cases_of
from transport.experiments.claim import (
    AS_PRINTED,
    CENTRALIZED,
    CLOSED_LOOP,
    GUSTS,
    ONE_EACH,
    ONE_PROCESSOR,
    SAME_RATE,
    SECONDS,
    STEPS,
    STILL,
    Compared,
    Row,
    compare,
    verdict,
)
from transport.experiments.computation import (
    MANEUVER,
    REPEATS,
    SHRINK,
    Load,
    compared,
    equal_period_s,
    faster_and_faster,
    step_ms,
)
from transport.experiments.flight import NUMBERS, Result
from transport.experiments.statistics import estimate

AGENTS = 4
LONGEST_S = 0.05


def load(period_s: float, one_each: float) -> Load:
    """What somebody computes."""
    return Load(
        controller=AS_PRINTED,
        kept=STEPS,
        period_s=period_s,
        horizon=20,
        agents=AGENTS,
        step_ms=1.0,
        reference_step_ms=10.0,
        one_each=one_each,
    )


def power(factor: float, exponent: float) -> Callable[[float], Load]:
    """Computation that grows as a power of the rate."""
    return lambda period_s: load(period_s, factor * (period_s / LONGEST_S) ** -exponent)


@pytest.mark.parametrize("exponent", [1.0, 2.3])
@pytest.mark.parametrize(("budget", "agents"), [(ONE_EACH, 1), (ONE_PROCESSOR, AGENTS)])
def test_equal_computation(exponent: float, budget: str, agents: int) -> None:
    """The period at which a power law passes the reference's computation, to the tenth of a millisecond above it."""
    loads = list(faster_and_faster(power(0.1, exponent), LONGEST_S))
    exact_s = LONGEST_S * (0.1 * agents) ** (1.0 / exponent)
    period_s = equal_period_s(loads, budget)
    assert period_s is not None
    assert exact_s - 1e-9 <= period_s < exact_s + 2e-4
    assert period_s == round(period_s, 4)


def test_who_computes_more_anyway_has_no_such_rate() -> None:
    """A team that computes more than the reference at its rate would have to be slower than it."""
    loads = [load(LONGEST_S, 0.3)]
    assert equal_period_s(loads, ONE_PROCESSOR) is None
    assert equal_period_s(loads, ONE_EACH) == LONGEST_S
    assert equal_period_s([], ONE_EACH) is None


def test_measured_until_each_alone_computes_more() -> None:
    """Periods shrink by a constant factor and end behind the first at which an agent computes more."""
    loads = list(faster_and_faster(power(0.3, 1.0), LONGEST_S))
    assert [entry.one_each > 1.0 for entry in loads] == [False] * (len(loads) - 1) + [True]
    for longer, shorter in itertools.pairwise(loads):
        assert shorter.period_s / longer.period_s == pytest.approx(SHRINK, abs=5e-3)
    endless = list(faster_and_faster(power(1e-6, 1.0), LONGEST_S))
    assert equal_period_s(endless, ONE_PROCESSOR) == endless[-1].period_s


def test_one_slow_minute_does_not_decide() -> None:
    """Of several pairs of flights the median ratio counts, so one that was disturbed changes nothing."""
    reference, candidate = (claim.setup_of(name, [MANEUVER]) for name in (CENTRALIZED, AS_PRINTED))
    own, first = iter([2.0, 50.0, 2.0]), iter([8.0, 8.0, 8.0])
    assert REPEATS == 3

    def measured(setup: Setup) -> float:
        return next(first if setup is reference else own)

    found = compared(reference, candidate, AS_PRINTED, STEPS, measure=measured)
    assert (found.step_ms, found.reference_step_ms, found.one_each, found.one_processor) == (2.0, 8.0, 0.25, 1.0)


def test_a_step_takes_time() -> None:
    """Centralized control of four computes more than one of four agents, whatever machine this is."""
    assert (
        step_ms(claim.setup_of(CENTRALIZED, [MANEUVER])) > 1.5 * step_ms(claim.setup_of(AS_PRINTED, [MANEUVER])) > 0.0
    )


@pytest.mark.parametrize(
    ("kept", "period_s", "horizon"), [(STEPS, 0.01, 20), (SECONDS, 0.01, 100), (SECONDS, 0.05, 20), (SECONDS, 2.0, 1)]
)
def test_horizons(kept: str, period_s: float, horizon: int) -> None:
    """A faster controller looks ahead as many steps or as many seconds."""
    assert claim.horizon_of(20, 0.05, period_s, kept) == horizon


LOADS = [
    replace(load(period_s, 0.2 * LONGEST_S / period_s), controller=controller, kept=kept)
    for controller, kept in ((AS_PRINTED, STEPS), (AS_PRINTED, SECONDS), (CLOSED_LOOP, SECONDS))
    for period_s in (0.05, 0.025, 0.0125, 0.00625)
]


def test_rows() -> None:
    """One reference; both distributed controllers at its rate, and at either reading of its computation."""
    rows = claim.rows(0.05, 20, LOADS)
    assert [(row.controller, row.budget, row.kept, row.period_s, row.horizon) for row in rows] == [
        (CENTRALIZED, claim.REFERENCE, STEPS, 0.05, 20),
        (AS_PRINTED, SAME_RATE, STEPS, 0.05, 20),
        (AS_PRINTED, ONE_PROCESSOR, STEPS, 0.04, 20),
        (AS_PRINTED, ONE_PROCESSOR, SECONDS, 0.04, 25),
        (AS_PRINTED, ONE_EACH, STEPS, 0.01, 20),
        (AS_PRINTED, ONE_EACH, SECONDS, 0.01, 100),
        (CLOSED_LOOP, SAME_RATE, STEPS, 0.05, 20),
        (CLOSED_LOOP, ONE_PROCESSOR, SECONDS, 0.04, 25),
        (CLOSED_LOOP, ONE_EACH, SECONDS, 0.01, 100),
    ]


def test_every_row_can_be_flown() -> None:
    """Rates and horizons reach the scenarios, in still air and in gusts; without gusts there is still air alone."""
    rows = claim.rows(0.05, 20, LOADS)
    points = claim.experiment(rows, 0.5).points
    cases = cases_of(points, [MANEUVER], 1, timed=True)
    assert len(cases) == 2 * len(rows)
    for case in cases:
        labels, scenario = points[case.point].labels, case.scenario
        assert scenario.controller.sampling_period_s == labels["period_s"]
        assert scenario.controller.horizon == labels["horizon"]
        assert scenario.plant.wind.gust_mps == [0.5 if labels["weather"] == GUSTS else 0.0] * 3
    assert {point.labels["weather"] for point in claim.experiment(rows, 0.0).points} == {STILL}


COSTS = {CENTRALIZED: (1.0, 2.0, 4.0), AS_PRINTED: (1.2, 2.2, 4.8)}


def flown(outcome: Callable[[Case], str] = lambda _: "completed") -> list[Compared]:
    """Three seeds of wind under two controllers, with made-up costs."""
    rows = claim.rows(0.05, 20, [])[:2]
    points = [point for point in claim.experiment(rows, 0.5).points if point.labels["weather"] == GUSTS]
    cases = cases_of(points, [MANEUVER], 3, timed=True)
    results = []
    for case in cases:
        numbers: dict[str, float | None] = dict.fromkeys(NUMBERS)
        numbers["cost_mean"] = COSTS[str(points[case.point].labels["controller"])][case.scenario.seed]
        numbers["lost_s"] = None if outcome(case) == "completed" else 3.5
        numbers["cpu_team_tick_ms"] = 5.0 * (1 + case.point)
        results.append(Result(key=case.key, outcome=outcome(case), reason="", numbers=numbers))
    return compare(points, cases, results)


def test_ratios_are_taken_seed_by_seed() -> None:
    """The mean of ratios in the same wind, not the ratio of means; computation is per second of flight."""
    central, printed = flown()
    ratios = estimate([1.2, 1.1, 1.2])
    assert printed.ratios["cost_mean"] == ratios
    assert central.ratios["cost_mean"] == estimate([1.0] * 3)
    per_second = printed.numbers["cpu_team_s_per_s"]
    assert per_second is not None
    assert per_second.mean == pytest.approx(0.01 / 0.05)


def test_lost_flights_are_not_compared() -> None:
    """A lost flight has no ratio, and a lost reference takes away those of its seed."""
    central, printed = flown(lambda case: "diverged" if case.point == 1 and case.scenario.seed == 0 else "completed")
    assert (printed.flights, printed.completed, printed.lost_s) == (3, 2, (3.5,))
    assert printed.ratios["cost_mean"] == estimate([1.1, 1.2])
    assert claim.judged(printed) == "lost"
    assert "1 of 3 flights lost, the first at 3.5 s" in verdict([central, printed])[0]
    central, printed = flown(lambda case: "diverged" if case.point == 0 and case.scenario.seed == 1 else "completed")
    assert printed.ratios["cost_mean"] == estimate([1.2, 1.2])


def made(ratios: list[float], budget: str = SAME_RATE, weather: str = STILL, kept: str = STEPS) -> Compared:
    """A row with given ratios of the mean cost."""
    row = Row(controller=AS_PRINTED, budget=budget, kept=kept, period_s=0.05, horizon=20)
    found = {"cost_mean": estimate(ratios), "cost_max": estimate(ratios)}
    return Compared(row=row, weather=weather, flights=len(ratios), lost_s=(), numbers=found, ratios=found)


@pytest.mark.parametrize(
    ("ratios", "words"),
    [
        ([1.05], "slightly worse"),
        ([0.95], "slightly better"),
        ([1.3], "worse"),
        ([0.7], "better"),
        ([1.8], "much worse"),
        ([1.0], "no difference that can be told"),
        ([1.0, 1.1], "no difference that can be told"),
        ([1.04, 1.05, 1.06], "slightly worse"),
        ([0.94, 0.95, 0.96], "slightly better"),
    ],
)
def test_words_follow_from_the_numbers(ratios: list[float], words: str) -> None:
    """Better or worse only if the confidence interval leaves out equal, and how much by the mean."""
    assert claim.judged(made(ratios)) == words


def test_the_papers_statements() -> None:
    """Each holds, does not hold or depends on the weather, by what was measured."""
    rows = [
        made([1.98], weather=STILL),
        made([1.08, 1.081], weather=GUSTS),
        made([1.08], ONE_PROCESSOR, STILL),
        made([0.952, 0.953], ONE_PROCESSOR, GUSTS),
        made([1.2], ONE_EACH, STILL, SECONDS),
    ]
    statements = verdict(rows)[len(rows) + 1 :]
    assert statements[0] == (
        '"slightly worse at the same rate": holds (much worse in still air, slightly worse in gusts)'
    )
    assert ": depends on the weather (slightly worse in still air, slightly better in gusts)" in statements[1]
    assert statements[2].endswith("no such rate, even at the centralized one's they compute more")
    assert statements[4].endswith("as many seconds of horizon: does not hold (worse in still air)")


def test_an_interval_of_two_is_wide() -> None:
    """Student's interval of two ratios: 12.7 standard errors; the words know."""
    ratio = estimate([1.0, 1.02])
    assert ratio is not None
    assert ratio.half_width == pytest.approx(12.706 * math.sqrt(2.0 * 0.01**2) / math.sqrt(2.0), rel=1e-3)
    assert claim.judged(made([1.0, 1.02])) == "no difference that can be told"


def test_the_whole_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Measures, flies, compares, draws, judges; a folder goes on with the rates it has, but not with other settings."""
    out = tmp_path / "out"
    arguments = ("experiment", "paper", "--quick", "--gust", "0", "--jobs", "1", "--out", out)
    result = here(*arguments, "--set", ticks(6))
    assert result.exit_code == 0, result.output
    files = {"comparison.csv", "computation.csv", "cases.csv", "verdict.txt", "maneuver.png", "maneuver.svg"}
    assert files <= {path.name for path in out.iterdir()}
    with (out / "comparison.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["controller"] for row in rows[:2]] == [CENTRALIZED, AS_PRINTED]
    assert float(rows[0]["cost_mean_ratio"]) == 1.0
    assert all(float(row["period_s"]) <= 0.05 for row in rows)
    words = (out / "verdict.txt").read_text()
    assert words.partition("\nmachine")[0].strip() in result.stdout
    assert '"slightly worse at the same rate": ' in words

    def never(*_: object, **__: object) -> None:
        raise AssertionError("measured or flown again")

    monkeypatch.setattr(claim, "compared", never)
    monkeypatch.setattr("transport.experiments.workers.fly_in_memory", never)
    again = here(*arguments, "--set", ticks(6))
    assert again.exit_code == 0, again.output
    assert (out / "verdict.txt").read_text() == words
    other = here(*arguments, "--set", ticks(7))
    assert other.exit_code == 2
    assert "--set: expected the settings" in other.stderr
