"""Options of experiments: repetitions, changes of scenarios, and runs at the same time."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from transport.cli.commands import experiment
from transport.cli.commands.experiment import EXPERIMENTS, ExperimentOptions
from transport.experiments.cases import Case, ExperimentError

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
