"""The paper's comparison.

Periods of equal computation, cost curves seed by seed, and the whole command.
"""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.results import here
from tests.support.runs import ticks
from transport.experiments.cases import Case, ExperimentError, cases_of
from transport.experiments.paper import comparison_report, controllers_and_periods
from transport.experiments.paper.comparison_curves import ComparisonCurve, curves_of, equal_periods
from transport.experiments.paper.controllers_and_periods import (
    CENTRALIZED,
    CLOSED_LOOP,
    GUSTS,
    MANEUVER,
    PAPER,
    SECONDS,
    STEPS,
    STILL,
    Cell,
)
from transport.experiments.run_numbers import NUMBERS, resource_use
from transport.experiments.simulation import ERROR, Result
from transport.experiments.statistics import estimate
from transport.experiments.sweep import Swept

AGENTS = 4
LONGEST_S = 0.1
REFERENCE = Cell(controller=CENTRALIZED, period_s=0.05, horizon=20)
PERIODS_S = [factor * REFERENCE.period_s for factor in controllers_and_periods.GRID]


def test_the_runs_of_the_comparison() -> None:
    """Each cell once, timed in still air on a maneuver of its own; costs in still air, and in gusts by seed.

    A horizon keeps the reference's 20 steps, or its second.
    """
    options = comparison_report.ComparisonOptions(
        settings=(ticks(9),), seeds=3, gust_mps=0.5, quick=True
    )
    planned = comparison_report.plan(options, simulated_before=True)
    assert planned.reference == REFERENCE
    long, short = (0.05, 20), (0.025, 20)
    in_seconds = [long, (0.025, 40)]
    found = {curve: [cell[1:] for cell in cells] for curve, cells in planned.cells.items()}
    assert found == {
        (CENTRALIZED, STEPS): [long, short],
        (CENTRALIZED, SECONDS): in_seconds,
        (PAPER, SECONDS): in_seconds,
        (PAPER, STEPS): [long, short],
        (CLOSED_LOOP, SECONDS): in_seconds,
    }
    distinct = 3 + 3 + 2
    assert len(planned.timed) == distinct
    assert len(planned.cases) == distinct * (1 + 3)
    for cases, duration_s in ((planned.timed, 0.4), (planned.cases, 9 * 0.05)):
        for case in cases:
            (phase,) = case.scenario.maneuver.phase
            assert phase.duration_s == pytest.approx(duration_s)
    assert not any(case.scenario.plant.wind.gust_mps[0] for case in planned.timed)
    gusts = [case.scenario.plant.wind.gust_mps for case in planned.cases]
    assert gusts == [(0.0,) * 3] * distinct + [(0.5,) * 3] * 3 * distinct
    assert all(case.more is resource_use for case in planned.timed)


@pytest.mark.parametrize("exponent", [1.0, 2.3])
@pytest.mark.parametrize("agents", [1, AGENTS])
def test_equal_computation(exponent: float, agents: int) -> None:
    """The period at which a power law passes the reference's computation is found exactly, whatever the grid."""
    periods_s = np.array(PERIODS_S)
    exact_s = LONGEST_S * (0.2 * agents) ** (1.0 / exponent)
    low_s, high_s = equal_periods(
        periods_s, agents * 0.2 * (periods_s[:, np.newaxis] / LONGEST_S) ** -exponent
    )
    assert low_s == high_s == pytest.approx(exact_s, rel=1e-12)


@pytest.mark.parametrize(
    ("loads", "expected_s"),
    [
        ([0.5, 0.7, 0.9], (0.0, 0.0)),  # less than the reference even at the shortest period
        ([1.1, 1.5, 3.0], (math.inf, math.inf)),  # more even at the longest
        ([0.5, 2.0, 1.5], (0.1 / math.sqrt(2.0),) * 2),  # a decrease is noise
        # Of several repetitions the range.
        ([[0.5, 0.5, 0.25], [2.0, 1.0, 1.0], [2.0, 2.0, 2.0]], (0.05, 0.1 / math.sqrt(2.0))),
    ],
)
def test_equal_computation_beyond_the_measured_periods(
    loads: list[float] | list[list[float]], expected_s: tuple[float, float]
) -> None:
    """The range of periods is open at the end beyond which it lies."""
    periods_s = np.array([0.1, 0.05, 0.025])
    repeated = np.array(loads).reshape(len(periods_s), -1)
    assert equal_periods(periods_s, repeated) == pytest.approx(expected_s)


# Costs of three seeds of wind, by controller and period.
COSTS = {
    (CENTRALIZED, 0.05): (1.0, 2.0, 4.0),
    (PAPER, 0.1): (4.0, 8.0, 16.0),
    (PAPER, 0.05): (1.2, 2.2, 4.8),
    (PAPER, 0.025): (0.9, 1.8, 3.6),
}


def both_curves(
    outcome: Callable[[Case], str] = lambda _: "completed",
    seeds: int = 3,
    costs: Mapping[tuple[str, float], Sequence[float]] = COSTS,
    weathers: Sequence[str] = (GUSTS,),
) -> list[ComparisonCurve]:
    """The cost curves of the centralized controller and the paper's algorithm, with made-up costs."""
    cells = [
        Cell(controller=controller, period_s=period_s, horizon=20) for controller, period_s in COSTS
    ]
    experiment = controllers_and_periods.experiment(cells, 0.5)
    points = [point for point in experiment.points if point.labels["weather"] in weathers]
    cases = cases_of(points, [MANEUVER], seeds)
    results = []
    for case in cases:
        numbers: dict[str, float | None] = dict.fromkeys(NUMBERS)
        labels = points[case.point].labels
        numbers["cost_mean"] = numbers["cost_max"] = costs[
            str(labels["controller"]), float(labels["period_s"])
        ][case.scenario.seed]
        numbers["lost_s"] = None if outcome(case) == "completed" else 3.5
        results.append(Result(key=case.key, outcome=outcome(case), reason="", numbers=numbers))
    curves = {(CENTRALIZED, STEPS): cells[:1], (PAPER, STEPS): cells[1:]}
    swept = Swept(
        experiment=replace(experiment, points=tuple(points)), cases=cases, results=results
    )
    measurement = replace(experiment, points=experiment.points[: len(cells)])
    first = len(points) - len(cells)  # of the points in gusts, which are repeated
    repeated = [replace(case, point=case.point - first) for case in cases if case.point >= first]
    # Of three repetitions the median is 1 ms; neither their mean nor their largest is.
    times = [
        Result(
            key=case.key,
            outcome="completed",
            reason="",
            numbers={"cpu_step_p50_ms": (0.5, 9.0, 1.0)[case.scenario.seed]},
        )
        for case in repeated
    ]
    timed = Swept(experiment=measurement, cases=repeated, results=times)
    return curves_of(curves, timed, swept, REFERENCE)


def paper_curve(
    outcome: Callable[[Case], str] = lambda _: "completed",
    costs: Mapping[tuple[str, float], Sequence[float]] = COSTS,
) -> ComparisonCurve:
    """The curve of the paper's algorithm in gusts."""
    _, curve = both_curves(outcome, costs=costs)
    return curve


def test_each_weather_has_the_curves_of_all_controllers() -> None:
    """That of the reference is the first; its team is one agent."""
    curves = both_curves(weathers=(STILL, GUSTS))
    assert [(curve.weather, curve.controller) for curve in curves] == [
        (weather, controller) for weather in (STILL, GUSTS) for controller in (CENTRALIZED, PAPER)
    ]
    (row,) = curves[-2].rows()
    assert (row["kept"], row["weather"], row["cost_ratio"]) == (STEPS, GUSTS, 1.0)
    assert row["cpu_team_s_per_s"] == row["cpu_agent_s_per_s"] == pytest.approx(0.02)


def at(case: Case, controller: str, period_s: float) -> bool:
    """Return whether a case is of a controller at a period."""
    scenario = case.scenario
    return (
        scenario.name == controllers_and_periods.SCENARIOS[controller]
        and scenario.controller.sampling_period_s == period_s
    )


def test_ratios_are_taken_seed_by_seed() -> None:
    """The mean of ratios in the same wind, not the ratio of means; the curve goes through them."""
    curve = paper_curve()
    assert [cell.period_s for cell in curve.cells] == [0.1, 0.05, 0.025]
    mean = estimate([1.2, 1.1, 1.2])
    row = list(curve.rows())[1]
    assert mean is not None
    assert mean[:3] == (row["cost_ratio"], row["cost_ratio_ci95"], 3)
    # Of 1 ms in a period of 50 ms, by each of four agents.
    times = [row[f"cpu_{name}"] for name in ("step_ms", "agent_s_per_s", "team_s_per_s")]
    assert times == pytest.approx([1.0, 0.02, 0.08])
    assert curve.cost_ratios(0.05) == pytest.approx([1.2, 1.1, 1.2])


def test_between_periods_the_cost_is_a_power_of_the_period() -> None:
    """Halfway between two periods, by their ratio, the cost is the geometric mean of theirs, for each seed."""
    found = paper_curve().cost_ratios(0.05 * math.sqrt(2.0))
    assert found == pytest.approx([math.sqrt(4.0 * ratio) for ratio in (1.2, 1.1, 1.2)])


def test_a_range_of_periods_is_cut_to_the_grid() -> None:
    """The cost is the lowest and the highest over the rest; no period in the grid has no cost."""
    curve = paper_curve()
    assert curve.cost_range(0.0, math.inf) == pytest.approx((0.9, 4.0))
    assert curve.cost_range(0.2, math.inf) is None
    assert curve.cost_range(0.0, 0.02) is None


def test_a_range_of_costs_has_their_intervals() -> None:
    """Student's 95 % about the mean of the seeds, not below zero; a range of one period has its cost."""
    curve = paper_curve()
    mean = estimate([1.2, 1.1, 1.2])
    assert mean is not None
    assert mean.half_width is not None
    around = (mean.mean - mean.half_width, mean.mean + mean.half_width)
    assert curve.cost_range(0.05, 0.05) == pytest.approx(around)

    apart = paper_curve(costs={**COSTS, (PAPER, 0.05): (0.1, 0.2, 40.0)})
    low, high = apart.cost_range(0.0, math.inf) or (math.nan, math.nan)
    assert low == 0.0
    assert high > 10.0  # not that of an end


@pytest.mark.parametrize(
    ("seed", "outcome", "cost", "problem"),
    [
        (0, "diverged", 1.0, "paper: expected a centralized controller that completes, got one that"),
        (2, "diverged", 1.0, "paper: expected a centralized controller that completes, got one that"),
        (1, "completed", 0.0, "paper: expected a centralized controller that completes, got one that"),
        (1, ERROR, 1.0, "a run raised an error: "),
    ],
)  # fmt: skip
def test_without_a_reference_in_each_weather_there_is_no_comparison(
    seed: int, outcome: str, cost: float, problem: str
) -> None:
    """The centralized controller completes with every seed, at a cost that others can be compared with."""
    of_reference = [1.0, 2.0, 4.0]
    of_reference[seed] = cost

    def ends(case: Case) -> str:
        is_it = at(case, CENTRALIZED, 0.05) and case.scenario.seed == seed
        return outcome if is_it else "completed"

    with pytest.raises(ExperimentError) as refusal:
        paper_curve(ends, costs={**COSTS, (CENTRALIZED, 0.05): of_reference})
    assert str(refusal.value).startswith(problem)


def test_diverged_runs_are_not_compared() -> None:
    """Next to a period with a diverged run the cost is infinite; elsewhere the curve is unchanged."""
    curve = paper_curve(
        lambda case: "diverged" if at(case, PAPER, 0.1) and case.scenario.seed == 0 else "completed"
    )
    assert [next(curve.rows())[name] for name in ("flights", "completed", "first_lost_s")] == [
        3,
        2,
        3.5,
    ]
    assert curve.cost_range(0.07, 0.08) == (math.inf, math.inf)
    assert (curve.cost_range(0.04, 0.06) or (0.0, 0.0))[1] == math.inf
    assert curve.cost_ratios(0.05) == pytest.approx([1.2, 1.1, 1.2])


def test_the_table_has_every_number_in_the_unit_of_its_column() -> None:
    """A row of curves.csv, whose numbers all differ, as it is shown."""
    row: controllers_and_periods.Row = {
        "weather": GUSTS,
        "controller": PAPER,
        "kept": STEPS,
        "flights": 3,
        "completed": 2,
        "period_s": 0.025,
        "horizon": 40,
        "cost_mean": 0.0012345,
        "cost_ratio": 1.2345,
        "cost_ratio_ci95": 0.0678,
        "cost_ratio_min": 1.2,
        "cost_ratio_max": 1.2691,
        "attitude_max_deg": 3.456,
        "swing_m": 0.4567,
        "cpu_step_ms": 1.987,
        "cpu_agent_s_per_s": 0.3456,
        "cpu_team_s_per_s": 1.3824,
    }
    shown = comparison_report.Compared(curves=[], curve_rows=[row], range_rows=[]).table
    columns = {str(column.header): list(column.cells) for column in shown.columns}
    assert columns == {
        "weather": [GUSTS],
        "controller": [PAPER],
        "horizon\nkept": [STEPS],
        "done": ["2/3"],
        "T_s\n(ms)": ["25.0"],
        "N_p": ["40"],
        "cost\n(1e-3)": ["1.234"],
        "cost over\ncentralized": ["1.234 [1.200, 1.269]"],
        "attitude\n(deg)": ["3.46"],
        "swing\n(m)": ["0.457"],
        "CPU step\n(ms)": ["1.99"],
        "agent\n(s/s)": ["0.346"],
        "team\n(s/s)": ["1.382"],
    }


@pytest.mark.slow
def test_the_whole_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All files are written; resuming uses the measured times."""
    out = tmp_path / "out"
    arguments = ("experiment", "paper", "--quick", "--gust", "0", "--jobs", "1", "--out", out)
    result = here(*arguments, "--set", ticks(6))
    assert result.exit_code == 0, result.output
    files = {"curves.csv", "ranges.csv", "computation.csv", "cases.csv", "report.md"}
    files |= {f"{figure}.{kind}" for figure in ("figure", "maneuver") for kind in ("png", "svg")}
    assert files <= {path.name for path in out.iterdir()}
    with (out / "curves.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {(row["controller"], row["kept"]) for row in rows} == set(controllers_and_periods.CURVES)
    assert float(rows[0]["cost_ratio"]) == 1.0
    assert all(float(row["cpu_team_s_per_s"]) > 0.0 for row in rows)
    with (out / "ranges.csv").open(newline="") as file:
        ranges = list(csv.DictReader(file))
    assert (ranges[0]["at"], ranges[0]["T_s"]) == ("the same rate", "50 ms")
    assert ranges[0]["cost"].startswith("x")
    text = (out / "report.md").read_text()
    assert all(
        line.removeprefix("- ") in result.stdout for line in text.partition("\n\n")[0].splitlines()
    )

    def never(*_: object, **__: object) -> None:
        raise AssertionError("measured or run again")

    monkeypatch.setattr(
        "transport.experiments.paper.comparison_report.draw_maneuver", lambda *_: []
    )
    monkeypatch.setattr("transport.experiments.paper.comparison_report.simulate_here", never)
    monkeypatch.setattr("transport.experiments.workers.simulate", never)
    again = here(*arguments, "--set", ticks(6))
    assert again.exit_code == 0, again.output
    assert (out / "report.md").read_text() == text
