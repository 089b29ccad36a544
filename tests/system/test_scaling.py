"""Teams of increasing size: the sweep, resource use of a run, fitted growth, and the whole command."""

import csv
from pathlib import Path

import pytest

from tests.support.results import here, kept
from tests.support.runs import ticks
from transport.experiments import design_experiments
from transport.experiments.cases import cases_of
from transport.experiments.declaration import EXPERIMENTS
from transport.experiments.result_tables import WIDTH
from transport.experiments.run_numbers import resource_use

DONE, USAGE, SCENARIO = 0, 2, 3
SIZES = EXPERIMENTS["scaling"].options["sizes"].default
TICKS = 4
SMALL = ("experiment", "scaling", "--quick", "--max", "4", "--set", ticks(TICKS))
FLIGHTS = 5  # 2 and 4 UAVs distributed and centralized, 4 in pairs


@pytest.mark.slow
def test_sizes_and_ownerships() -> None:
    """Sizes go up to the largest team requested, also an unusual one.

    Pairs exist only for even numbers above two.
    """
    points = list(design_experiments.scaling(9, SIZES))
    sizes = {
        name: [point.labels["uavs"] for point in points if point.labels["ownership"] == name]
        for name in design_experiments.OWNERSHIPS
    }
    every = [2, 3, 4, 6, 8, 9]
    assert sizes == {"distributed": every, "pairs": [4, 6, 8], "centralized": every}
    for point, case in zip(points, cases_of(points, [], 1, more=resource_use), strict=True):
        assert len(case.scenario.system.uav) == point.labels["uavs"]
        assert len(case.scenario.owned) == point.labels["agents"]
        assert case.more is resource_use


REFUSED = [
    (
        ("--max", "17"),
        USAGE,
        "invalid value for '--max': expected less than or equal to 16, got '17'",
    ),
    (("--max", "many"), USAGE, "invalid value for '--max'"),
    (("--jobs", "0"), USAGE, "--jobs"),
    (
        ("--set", "controller.horizon=0"),
        SCENARIO,
        "controller.horizon=0: expected greater than or equal to 1",
    ),
    (("--set", "agents.owned=[[1,2],[3,4]]"), SCENARIO, "agents.owned=[[1,2],[3,4]]: expected"),
    (
        ("--set", "links.override=[{from='agent3',to='agent1',loss=0.1}]"),
        SCENARIO,
        "links.override.1.from: expected one of plant, agent1, agent2, got 'agent3'",
    ),
]


@pytest.mark.parametrize(
    ("arguments", "code", "expected"), REFUSED, ids=[" ".join(row[0]) for row in REFUSED]
)
def test_what_cannot_be_is_refused(
    arguments: tuple[str, ...],
    code: int,
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A bad option ends with its exit code, expected and got; no run starts and no folder appears."""
    monkeypatch.chdir(tmp_path)
    result = here("experiment", "scaling", *arguments)
    assert result.exit_code == code, result.output
    assert expected in " ".join(result.stderr.replace("│", " ").split())
    assert result.stdout == ""
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return a trial with one run at a time, and its output."""
    folder = tmp_path_factory.mktemp("scaling") / "one"
    result = here(*SMALL, "--out", folder)
    assert result.exit_code == DONE, result.output
    assert "--quick: a trial, no measurement" in result.stderr
    return folder, result.stdout


def test_a_trial_is_whole(trial: tuple[Path, str]) -> None:
    """Files, rows, table and sentences of a trial; the caption names the maneuver."""
    folder, printed = trial
    names = {
        "experiment.json",
        "results.jsonl",
        "points.csv",
        "cases.csv",
        "figure.png",
        "figure.svg",
        "report.md",
    }
    assert {path.name for path in folder.iterdir()} == names
    assert kept(folder) == FLIGHTS
    with (folder / "cases.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["ownership"], row["uavs"], row["outcome"]) for row in rows] == [
        (ownership, uavs, "completed")
        for ownership, sizes in (("distributed", "24"), ("pairs", "4"), ("centralized", "24"))
        for uavs in sizes
    ]
    for row in rows:
        assert all(float(row[name]) >= 0.0 for name in ("plans_per_tick", "plan_bytes_per_s"))
        assert all(float(value) > 0.0 for name, value in row.items() if name.startswith("cpu_"))
    table, _, rest = printed.partition("\n\n")
    assert "(trial, no measurement)" in table
    assert "0.2 s of hover" in table
    assert max(len(line.rstrip()) for line in table.splitlines()) <= WIDTH
    assert "pairs: completes 1 of 1 runs, none diverged" in rest
    assert "machine: " in rest
