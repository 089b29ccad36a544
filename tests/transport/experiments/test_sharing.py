"""The sharing experiment: its points, its baselines, and messages against cost."""

import csv
from pathlib import Path

import pytest
from rich.console import Console

from tests.support.results import here
from tests.support.runs import ticks
from transport.experiments.cases import cases_of
from transport.experiments.errors import ExperimentError
from transport.experiments.network_sweeps import NETWORKS, sharing
from transport.experiments.simulation import NUMBERS, Result
from transport.experiments.statistics import statistics_of
from transport.experiments.table import WIDTH, table_of

HEARTBEAT_S = 0.5


def test_every_threshold_on_every_network() -> None:
    """Each network has all thresholds and, as its baseline, all plans sent; all points can be flown."""
    experiment = sharing(["resilient"], [0.05, 0.01], HEARTBEAT_S)
    found = [(p.group, p.labels["share_threshold"], p.baseline) for p in experiment.points]
    assert found == [(network, t, t == 0.0) for network in NETWORKS for t in (0.0, 0.01, 0.05)]
    cases = cases_of(experiment.points, [], 2)
    assert len({case.key for case in cases}) == len(cases) == 3 + 2 * 3  # chance is on the second network alone
    for case in cases:
        threshold = experiment.points[case.point].labels["share_threshold"]
        controller = case.scenario.controller
        assert controller.share == ("on_change" if threshold else "always")
        assert not threshold or (controller.share_threshold, controller.share_heartbeat_s) == (threshold, HEARTBEAT_S)


def test_costs_are_over_the_same_network() -> None:
    """A ratio of costs compares a network with itself when all plans are sent, not with the perfect one."""
    points = sharing(["resilient"], [0.01], HEARTBEAT_S).points
    costs = (2.0, 3.0, 8.0, 10.0)
    results = [
        [Result(key="", outcome="completed", reason="", numbers={**dict.fromkeys(NUMBERS), "cost_mean": cost})]
        for cost in costs
    ]
    assert [m.cost_ratio for m in statistics_of(points, results, NUMBERS)] == [1.0, 1.5, 1.0, 1.25]


def test_the_table_fits() -> None:
    """The table fits its width, also with confidence intervals."""
    points = sharing(["resilient"], [0.002], HEARTBEAT_S).points
    flights = [
        Result(key="", outcome="completed", reason="", numbers=dict.fromkeys(NUMBERS, number)) for number in (0.39, 0.4)
    ]
    console = Console(width=WIDTH)
    with console.capture() as capture:
        console.print(table_of("sharing", statistics_of(points, [flights] * len(points), NUMBERS)))
    assert "39.5 ±6.4" in capture.get()
    assert "…" not in capture.get()


@pytest.mark.parametrize(
    ("thresholds", "heartbeat_s", "text"),
    [
        ([0.0], 1.0, "--threshold: expected a share > 0, got 0"),
        ([0.1, 0.1], 1.0, "--threshold: expected each value once, got 0.1 2 times"),
        ([0.1], 0.0, "--heartbeat: expected a time > 0 s, got 0"),
    ],
)
def test_wrong_options(thresholds: list[float], heartbeat_s: float, text: str) -> None:
    """A wrong value is refused with option, expected and got."""
    with pytest.raises(ExperimentError) as caught:
        sharing(["resilient"], thresholds, heartbeat_s)
    assert str(caught.value) == text


def test_the_whole_command(tmp_path: Path) -> None:
    """The table has the share of plans sent, which falls with the threshold; the figure a curve for each network."""
    arguments = ("--threshold", "1000", "--heartbeat", "0.2", "--seeds", "1", "--jobs", "1", "--set", ticks(9))
    result = here("experiment", "sharing", *arguments, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    table = result.stdout.partition("\n\n")[0]
    assert "sent (%)" in table
    assert "…" not in table
    with (tmp_path / "points.csv").open(encoding="utf-8", newline="") as file:
        shares = [float(row["plans_shared_share"]) for row in csv.DictReader(file)]
    assert shares == pytest.approx([1.0, 3 / 9, 1.0, 3 / 9])  # ticks 0, 4 and 8
    drawn = (tmp_path / "figure.svg").read_text()
    assert "plans sent (%)" in drawn
    assert all(network in drawn for network in NETWORKS)
