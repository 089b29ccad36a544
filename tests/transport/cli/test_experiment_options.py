"""Options of experiments: repetitions, changes of scenarios, and runs at the same time."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from transport.cli.commands import experiment
from transport.cli.commands.experiment import EXPERIMENTS, ExperimentOptions
from transport.cli.main import app
from transport.experiments.cases import Case, ExperimentError
from transport.experiments.declaration import Values

DECLARED = replace(EXPERIMENTS["latency"], seeds=7, maneuver="long", quick_maneuver="short")


def options(**given: Any) -> ExperimentOptions:
    """Return the options of an experiment with 7 seeds and a maneuver of its own."""
    return ExperimentOptions(declared=DECLARED, **given)


def test_a_trial_has_two_seeds_and_the_short_maneuver() -> None:
    """Seeds that are given count; changes of the command line come last, so that they win."""
    assert [options(quick=quick).repetitions for quick in (False, True)] == [7, 2]
    assert [options(quick=quick, seeds=5).repetitions for quick in (False, True)] == [5, 5]
    assert options(settings=["a=1"]).changes() == ["long", "a=1"]
    assert options(settings=["a=1"], quick=True).changes() == ["short", "a=1"]


def test_a_folder_that_is_given_is_used(tmp_path: Path) -> None:
    """By default it is below runs/ and has the name of the experiment."""
    assert options(out=tmp_path).folder("latency") == tmp_path
    folder = options().folder("latency")
    assert folder.parent == Path("runs")
    assert folder.name.startswith("experiment-latency-")


@pytest.mark.parametrize(
    ("given", "most", "jobs"),
    [
        ({}, 100, 6),  # a core each
        ({}, 3, 3),  # as many as fit into the memory
        ({"jobs": 2}, 3, 2),
        ({"jobs": 20}, 100, 10),  # a case each
        ({"jobs": 4, "allow_large": True}, 3, 4),
        ({"jobs": 4}, 3, None),
    ],
)
def test_runs_at_the_same_time_fit_into_the_memory(
    given: dict[str, Any], most: int, jobs: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A larger number that is asked for is refused, unless large runs are allowed."""
    used: list[int] = []

    def on_cores(cases: Sequence[Case], jobs: int) -> list[Any]:
        assert len(cases) == 10
        used.append(jobs)
        return []

    monkeypatch.setattr(experiment, "on_cores", on_cores)
    monkeypatch.setattr(experiment, "most_workers", lambda _: most)
    monkeypatch.setattr("joblib.cpu_count", lambda: 6)
    cases: Any = [None] * 10
    if jobs is None:
        with pytest.raises(
            ExperimentError, match="--jobs: expected at most 3 runs so large, got 4"
        ):
            options(**given).simulate(cases)
    else:
        options(**given).simulate(cases)
    assert used == ([] if jobs is None else [jobs])


def test_a_trial_has_no_more_seeds_than_a_measurement() -> None:
    """One whose runs have no chance has one seed in both."""
    for seeds, expected in ((1, 1), (2, 2), (7, 2)):
        declared = replace(DECLARED, seeds=seeds)
        assert ExperimentOptions(declared=declared, quick=True).repetitions == expected


@pytest.mark.parametrize(
    ("default", "quick", "expected"),
    [
        ([0.1, 2.0], None, "Delays; by default 0.1, 2. Repeatable."),
        (["a", "b,c"], None, "Delays; by default a; b,c. Repeatable."),
        (5.0, 1.0, "Delays; by default 5."),
        (5.0, None, None),  # the command line shows it
    ],
)
def test_the_help_of_an_option_tells_its_default(
    default: Any, quick: Any, expected: str | None
) -> None:
    """Where the command line cannot, as a trial has another one, or a list has none."""
    values = Values(default=default, quick=quick, help="Delays.", metavar="SECONDS")
    parameter = experiment._parameter("delay", values)
    (option,) = parameter.annotation.__metadata__
    assert option.help == (expected or "Delays.")
    assert parameter.default == (default if expected is None else None)


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("drawn_as", ["lines", "scaling"])
def test_a_title_tells_a_trial_and_the_maneuver_that_was_timed(quick: bool, drawn_as: str) -> None:
    """Its length and phases."""
    phases = [SimpleNamespace(name=name, duration_s=1.5) for name in ("hover", "climb")]
    scenario = SimpleNamespace(maneuver=SimpleNamespace(phase=phases))
    cases = [SimpleNamespace(scenario=scenario)]
    swept: Any = SimpleNamespace(experiment=SimpleNamespace(drawn_as=drawn_as), cases=cases)
    title = experiment._title("latency", swept, options(quick=quick))
    first, *more = title.splitlines()
    assert first.startswith(f"latency{' (trial, no measurement)' if quick else ''}: ")
    assert more == (["3 s of hover, climb"] if drawn_as == "scaling" else [])


@pytest.mark.parametrize("quick", [False, True])
def test_a_trial_is_told(quick: bool, capsys: pytest.CaptureFixture[str]) -> None:
    """Before it is simulated."""
    options(quick=quick).folder("latency")
    assert capsys.readouterr().err == "--quick: a trial, no measurement\n" * quick


@pytest.mark.parametrize("gust", ["-0.1", "inf", "nan", "0"])
def test_gusts_of_the_comparison(gust: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Still air is one, too."""
    compared: list[Any] = []

    def compare(given: Any, *_: Any) -> Any:
        compared.append((given.gust_mps, given.quick))
        raise ExperimentError("enough")

    monkeypatch.setattr("transport.experiments.paper.comparison_report.compare", compare)
    ended = CliRunner().invoke(app, ["experiment", "paper", "--quick", "--gust", gust])
    assert ended.exit_code != 0
    assert compared == ([(0.0, True)] if gust == "0" else [])
    assert ("--gust: expected a speed >= 0 m/s" in ended.stderr) is (gust != "0")


@pytest.mark.parametrize(("given", "jobs"), [({}, 2), ({"jobs": 3}, 3)])
def test_an_experiment_may_declare_how_many_runs_are_parallel(
    given: dict[str, Any], jobs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one does that measures times; the command line comes first."""
    used: list[int] = []
    monkeypatch.setattr(experiment, "on_cores", lambda _cases, jobs: used.append(jobs))
    monkeypatch.setattr(experiment, "most_workers", lambda _: 100)
    monkeypatch.setattr("joblib.cpu_count", lambda: 6)
    cases: Any = [None] * 10
    ExperimentOptions(declared=replace(DECLARED, jobs=2), **given).simulate(cases)
    assert used == [jobs]


@pytest.mark.parametrize("large", [False, True])
@pytest.mark.parametrize("own", [None, ["paper", "eight"]])
def test_scenarios_are_read_with_all_changes(
    own: list[str] | None, large: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that are given, or else those of the declaration; none twice."""
    asked: list[Any] = []

    def read(path: Path, changes: Sequence[str], *, allow_large: bool) -> str:
        asked.append((path.stem, list(changes), allow_large))
        return path.stem

    monkeypatch.setattr(experiment, "read_scenario", read)
    names = own or list(DECLARED.scenarios)
    chosen = options(scenarios=own, settings=["a=1"], allow_large=large)
    found: Any = chosen.read()
    assert found == {name: name for name in names}
    assert asked == [(name, ["long", "a=1"], large) for name in names]
    with pytest.raises(ExperimentError, match="--scenario: expected each value once"):
        options(scenarios=["paper", "paper"]).read()


def test_an_experiment_with_teams_of_its_own_takes_no_scenario_and_no_cluster() -> None:
    """All others take both."""
    for declared in EXPERIMENTS.values():
        bound: Any = experiment._options_of(declared)
        left_out = bound.keywords.keys() - {"declared"}
        assert left_out == (set() if declared.scenarios else {"scenarios", "dask"})


def test_the_statistics_of_a_point_as_json() -> None:
    """Numbers that no run has are null."""
    number = SimpleNamespace(_asdict=lambda: {"mean": 1.0})
    point = SimpleNamespace(scenario="paper", text="0.1 s", labels={"delay_s": 0.1})
    statistics: Any = SimpleNamespace(
        point=point, runs=5, completed=3, errors=1, diverged_s=(2.0,), cost_ratio=1.5,
        numbers={"a": number, "b": None},
    )  # fmt: skip
    assert experiment._content(statistics) == {
        "scenario": "paper", "point": "0.1 s", "labels": {"delay_s": 0.1}, "runs": 5, "completed": 3,
        "errors": 1, "diverged_s": [2.0], "cost_ratio": 1.5, "numbers": {"a": {"mean": 1.0}, "b": None},
    }  # fmt: skip
