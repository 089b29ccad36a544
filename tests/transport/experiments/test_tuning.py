"""Choices of ours: horizon and terminal weight with and without delay, and a long hover at the end."""

import io
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from protocol.scenario.file import find_scenario, read_scenario
from protocol.scenario.schema import Scenario
from tests.support.results import here
from tests.support.runs import ticks
from transport.experiments import tuning
from transport.experiments.cases import cases_of
from transport.experiments.errors import ExperimentError
from transport.experiments.experiment import Experiment
from transport.experiments.figures import draw
from transport.experiments.simulation import NUMBERS, Result
from transport.experiments.statistics import statistics_of
from transport.experiments.table import WIDTH_OF_VARIANTS, table_of


def scenarios(*names: str) -> dict[str, Scenario]:
    """Scenarios by name."""
    return {name: read_scenario(find_scenario(name)) for name in names}


def test_horizons_weights_and_networks() -> None:
    """Each horizon on each network, with each weight where the horizon ends with one, else with the cost-to-go."""
    experiment = tuning.horizon(scenarios("paper", "resilient"), [5, 10, 30], [1.0, 20.0], 0.2)
    cases = cases_of(experiment.points, [], 3)
    count = {name: sum(point.scenario == name for point in experiment.points) for name in ("paper", "resilient")}
    assert count == {"paper": 2 * 4 * 3, "resilient": 2 * 4}
    assert len({case.key for case in cases}) == len(cases) == len(experiment.points)
    for case in cases:
        labels, scenario = experiment.points[case.point].labels, case.scenario
        assert scenario.controller.horizon == labels["horizon"]
        weight = scenario.controller.weights.terminal
        assert labels["terminal"] == ("cost-to-go" if scenario.controller.terminal == "riccati" else weight)
        assert scenario.links.delay_s == {"perfect": 0.0, "200 ms delay": 0.2}[str(labels["network"])]
    baselines = [point.labels for point in experiment.points if point.baseline]
    assert baselines == [{"network": "perfect", "horizon": 20, "terminal": end} for end in (5.0, "cost-to-go")]


def test_only_the_last_hover_is_longer() -> None:
    """The last phase has the duration asked for, the others keep theirs."""
    experiment = tuning.hover(scenarios("paper", "centralized"), [60.0, 5.0])
    durations = [
        [phase.duration_s for phase in case.scenario.maneuver.phase] for case in cases_of(experiment.points, [], 1)
    ]
    assert durations == [[5.0] * 5, [5.0] * 4 + [60.0]] * 2
    assert not any(point.baseline for point in experiment.points)


REFUSED: list[tuple[Callable[[], Experiment], str]] = [
    (lambda: tuning.horizon(scenarios("paper"), [0], [1.0], 0.2), "--horizon: expected a number of steps >= 1, got 0"),
    (lambda: tuning.horizon(scenarios("paper"), [5, 5], [1.0], 0.2), "--horizon: expected each value once, got 5 2 t"),
    (lambda: tuning.horizon(scenarios("paper"), [5], [0.0], 0.2), "--terminal: expected a weight > 0, got 0"),
    (lambda: tuning.horizon(scenarios("paper"), [5], [1.0], 0.0), "--delay: expected a delay > 0 s, got 0"),
    (lambda: tuning.hover(scenarios("paper"), [float("nan")]), "--duration: expected a duration > 0 s, got nan"),
]


@pytest.mark.parametrize(("build", "expected"), REFUSED, ids=[expected for _, expected in REFUSED])
def test_bad_values_are_refused(build: Callable[[], Experiment], expected: str) -> None:
    """A value that cannot be is refused with option, expected and got."""
    with pytest.raises(ExperimentError) as refusal:
        build()
    assert str(refusal.value).startswith(expected)


def test_a_maneuver_without_a_last_hover_is_refused() -> None:
    """Only a hover can last longer without going further."""
    climbing = read_scenario(
        find_scenario("paper"), ["maneuver.phase=[{name='climb',duration_s=1.0,displacement_m=[0,0,-1]}]"]
    )
    with pytest.raises(ExperimentError, match="--scenario: expected a maneuver that ends with a hover, got mine"):
        tuning.hover({"mine": climbing}, [60.0])


@pytest.mark.parametrize(
    "experiment",
    [
        tuning.horizon(scenarios("paper", "resilient"), [5, 30], [1.0], 0.2),
        tuning.hover(scenarios("paper", "centralized", "resilient"), [5.0, 60.0]),
    ],
    ids=lambda experiment: experiment.name,
)
def test_results_can_be_reported(experiment: Experiment, tmp_path: Path) -> None:
    """Completed and diverged runs have a place in figure and table."""
    results = []
    for index, _ in enumerate(experiment.points):
        numbers: dict[str, float | None] = dict.fromkeys(NUMBERS, 0.5)
        outcome = "diverged" if index % 3 == 2 else "completed"
        numbers["lost_s"] = 40.0 if outcome == "diverged" else None
        results.append([Result(key="k", outcome=outcome, reason="", numbers=numbers)])
    measured = statistics_of(experiment.points, results, NUMBERS[1:])
    assert all(path.stat().st_size > 0 for path in draw(experiment, measured, tmp_path))
    console = Console(width=WIDTH_OF_VARIANTS, record=True, file=io.StringIO())
    console.print(table_of(experiment.name, measured))
    text = console.export_text()
    assert "…" not in text
    assert "swing" in text


def test_the_commands(tmp_path: Path) -> None:
    """Both run from the command line; hover runs the centralized controller, too, unless told otherwise."""
    settings = ("--quick", "--jobs", "1", "--set", ticks(4), "--set", "controller.horizon=5")
    result = here("experiment", "horizon", *settings, "--scenario", "paper", "--horizon", "4", "--out", tmp_path / "h")
    assert result.exit_code == 0, result.output
    assert "paper: completes all 4 points" in result.stdout
    result = here("experiment", "hover", *settings, "--duration", "0.2", "--out", tmp_path / "o")
    assert result.exit_code == 0, result.output
    for name in ("paper", "centralized", "resilient"):
        assert f"{name}: completes all 1 points" in result.stdout
