"""`transport.sweep`: every combination once, results independent of workers, tables and figures."""

import csv
import gc
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

import transport
from transport.experiments.cases import Case, Point
from transport.experiments.declaration import Experiment
from transport.experiments.figures.axes_and_units import axis
from transport.experiments.run_numbers import NUMBERS
from transport.experiments.simulation import ERROR, Result
from transport.experiments.sweep import Swept
from transport.interface import swept_runs
from transport.model.kernels.casadi_functions import compile_functions
from transport.protocol.scenario.scenario_file import find_scenario

PHASES = (
    {"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]},
    {"name": "climb", "duration_s": 0.5, "displacement_m": [0.0, 0.0, -0.25]},
)
GRID = {"links.delay_s": [0.0, 0.1], "loss": [0.0, 0.3]}


def base(name: str = "resilient") -> transport.Scenario:
    """Return a scenario with a short maneuver."""
    return transport.Scenario(name, phases=PHASES)


@pytest.fixture(scope="module")
def table() -> transport.Sweep:
    """Return a sweep over delay and packet loss with two seeds, simulated in this process."""
    return transport.sweep({"mine": base()}, GRID, seeds=2, workers=1, progress=False)


def test_points_and_runs(table: transport.Sweep) -> None:
    """The points are the combinations in order.

    Random ones are repeated with each seed, others not.
    """
    points = table.rows()
    assert [
        (row["scenario"], row["links.delay_s"], row["loss"], row["flights"]) for row in points
    ] == [
        ("mine", 0.0, 0.0, 1),
        ("mine", 0.0, 0.3, 2),
        ("mine", 0.1, 0.0, 1),
        ("mine", 0.1, 0.3, 2),
    ]
    assert repr(table) == "Sweep(4 points, 6 runs)"
    assert "cost mean" in str(table)
    assert str(table).startswith("means of completed runs")
    assert points[0]["cost_ratio"] == 1.0
    assert points[2]["plan_age_mean_ticks"] > points[0]["plan_age_mean_ticks"]
    assert len(table.to_pandas("runs")) == 6
    assert list(table.to_pandas().columns)[:3] == ["scenario", "links.delay_s", "loss"]


def test_the_first_combination_of_each_base_is_its_baseline() -> None:
    """Costs are compared within a base; switches are texts, as a figure has no axis for them."""
    values: dict[str, list[Any]] = {
        "controller.disturbance.estimate": [False, True],
        "delay_s": [0.0, 0.1],
    }
    plan = swept_runs._plan({"a": base(), "b": base("paper")}, values, 2)
    assert [point.baseline for point in plan.points] == [True, False, False, False] * 2
    assert [point.scenario for point in plan.points] == ["a"] * 4 + ["b"] * 4
    switch = "controller.disturbance.estimate"
    assert plan.points[3].labels == {switch: "True", "delay_s": 0.1}
    assert len(plan.cases) == 8  # none has random parts


def test_a_point_is_the_run_of_fly(table: transport.Sweep) -> None:
    """A run of a sweep has the numbers of the same run alone."""
    alone = transport.fly(base(), delay_s=0.1, loss=0.3, seed=1, progress=False)
    (row,) = (
        r for r in table.rows("runs") if (r["links.delay_s"], r["loss"], r["seed"]) == (0.1, 0.3, 1)
    )
    assert row["cost_mean"] == alone.summary["cost"]["mean"]
    assert row["attitude_max_deg"] == alone.summary["attitude_max_deg"]


@pytest.mark.slow
def test_workers_do_not_change_results(table: transport.Sweep, tmp_path: Path) -> None:
    """Two processes give the bits of one.

    A folder has tables and figure, and is resumed without a run.
    """
    folder = tmp_path / "sweep"
    parallel = transport.sweep(
        {"mine": base()}, GRID, seeds=2, workers=2, folder=folder, progress=False
    )
    assert parallel.rows("runs") == table.rows("runs")
    with (folder / "cases.csv").open(encoding="utf-8") as file:
        assert [row["cost_mean"] for row in csv.DictReader(file)] == [
            str(r["cost_mean"]) for r in table.rows("runs")
        ]
    assert {"points.csv", "cases.csv", "figure.png", "figure.svg"} <= {
        path.name for path in folder.iterdir()
    }
    lines = (folder / "results.jsonl").read_text(encoding="utf-8")
    transport.sweep({"mine": base()}, GRID, seeds=2, workers=1, folder=folder, progress=False)
    assert (folder / "results.jsonl").read_text(encoding="utf-8") == lines


def test_figures(table: transport.Sweep) -> None:
    """Curves over any setting, one for each value of the others; a map of two."""
    first = table.plot()
    assert first.axes[-1].get_xlabel() == "delay of plans (ms)\nbars: range of 2 runs"
    assert [label.get_text() for label in first.axes[-1].get_xticklabels()] == ["0", "100"]
    assert [text.get_text() for text in first.legends[0].get_texts()] == [
        "loss of plans 0 %",
        "loss of plans 30 %",
    ]
    assert table.plot("loss").axes[-1].get_xlabel() == "loss of plans (%)\nbars: range of 2 runs"
    for along, up in (("links.delay_s", "loss"), ("loss", "links.delay_s")):
        panel = table.plot(along, kind="map").axes[0]
        titles = [axis(name).title for name in (along, up)]
        assert [panel.get_xlabel(), panel.get_ylabel()] == titles
    with pytest.raises(
        transport.ArgumentError, match=r"x: expected one of links.delay_s, loss, got 'delay'"
    ):
        table.plot("delay")


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"grid": {}}, "grid: expected settings other than the seed"),
    ({"grid": {"delay_s": 0.1}}, "delay_s: expected a list of values, got 0.1"),
    ({"grid": {"delay_s": []}}, "delay_s: expected different values, at least one, got"),
    ({"grid": {"delay_s": [0.1, 0.1]}}, "delay_s: expected different values"),
    (
        {"grid": {"solver": "daqp" * 50}},
        f"solver: expected a list of values, got '{'daqp' * 14}daq",
    ),
    (
        {"grid": {"radio": {"rate_mbps": 6.0}}},
        "radio: expected a list of values, got {'rate_mbps': 6.0}",
    ),
    ({"grid": {"horizon": [5] * 99}}, f"at least one, got [{'5, ' * 19}5,"),
    (
        {"grid": {"delay_s": [0.1], "links.delay_s": [0.2]}},
        "each once, got ['links.delay_s', 'links.delay_s']",
    ),
    ({"grid": {"seed": [1, 2]}}, "grid: expected settings other than the seed"),
    ({"grid": GRID, "seeds": 0}, "seeds: expected a number >= 1, got 0"),
    (
        {"grid": GRID, "base": []},
        "base: expected scenarios with different names, or a dictionary with labels, got []",
    ),
    ({"grid": GRID, "base": ["paper", "paper"]}, "base: expected scenarios with different names"),
]


@pytest.mark.parametrize(("arguments", "text"), WRONG)
def test_wrong_arguments(arguments: dict[str, Any], text: str) -> None:
    """Impossible sweeps are refused with the argument's name, expected and got, before the first run."""
    with pytest.raises(transport.ArgumentError) as caught:
        transport.sweep(**{"base": "paper", "progress": False, **arguments})
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 160  # long values are cut


def test_refused_before_the_first_run(tmp_path: Path) -> None:
    """A combination that cannot be simulated, or an address that is none, ends the sweep before it begins."""
    folder = tmp_path / "sweep"
    with pytest.raises(transport.ScenarioError, match="expected greater than or equal to 0"):
        transport.sweep("paper", {"delay_s": [0.0, -1.0]}, folder=folder, progress=False)
    with pytest.raises(
        transport.ExperimentError, match="expected an address such as tcp://host:8786"
    ):
        transport.sweep(
            "paper", {"delay_s": [0.0]}, workers="nowhere", folder=folder, progress=False
        )
    with pytest.raises(transport.ScenarioError, match=r"agents\.controller: its import from"):
        transport.sweep(
            "paper", {"agents.controller": ["nowhere:Mine"]}, folder=folder, progress=False
        )
    assert not folder.exists()


def test_a_sweep_with_an_error_has_its_tables_and_tells_its_progress(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line with the last run on standard error, unless it is hidden; there are as many workers as asked for."""
    asked: list[int | None] = []

    def simulated(cases: Sequence[Case], jobs: int | None) -> Iterator[Result]:
        asked.append(jobs)
        for case in cases:
            outcome = ERROR if case.scenario.links.delay_s else "completed"
            yield Result(
                key=case.key, outcome=outcome, reason="why", numbers=dict.fromkeys(NUMBERS)
            )

    monkeypatch.setattr(swept_runs, "on_cores", simulated)
    grid = {"delay_s": [0.0, 0.1]}
    for workers, folder in ((3, tmp_path / "new" / "sweep"), (None, None)):
        with pytest.raises(transport.ExperimentError, match="a run raised an error: why"):
            transport.sweep(
                base(), grid, workers=workers, folder=folder, progress=folder is not None
            )
        told = "2 of 2 runs done; last: resilient, delay_s 0.1, seed 0: error\n"
        told_of = capsys.readouterr().err
        assert told_of.endswith(told) if folder else told_of == ""
    assert asked == [3, None]
    assert {"points.csv", "cases.csv", "figure.png", "figure.svg"} <= {
        path.name for path in (tmp_path / "new" / "sweep").iterdir()
    }


@pytest.mark.parametrize(
    ("given", "labels"),
    [
        (find_scenario("paper"), ["paper"]),
        (["paper", base()], ["paper", "resilient"]),
        ({1: "paper", "b": find_scenario("paper")}, ["1", "b"]),
    ],
    ids=["file", "several", "by label"],
)
def test_scenarios_of_a_sweep_have_their_names_or_labels(given: Any, labels: list[str]) -> None:
    """A file, a name, a scenario, several of them, or labels of any kind."""
    assert list(swept_runs._scenarios(given)) == labels


# Of an interrupt that Python ignores, see below.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_ends_a_sweep(tmp_path: Path) -> None:
    """Ctrl-C raises KeyboardInterrupt; finished runs are kept in the folder."""
    long = transport.Scenario("paper", phases=[{**PHASES[0], "duration_s": 1e3}])
    compile_functions(4)
    # Python ignores one whose handler raises while an object is collected: a second follows, long
    # before the run ends by itself.
    gc.collect()
    timers = [threading.Timer(at_s, os.kill, (os.getpid(), signal.SIGINT)) for at_s in (1.0, 8.0)]
    for timer in timers:
        timer.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            transport.sweep(
                long, {"delay_s": [0.0]}, workers=1, folder=tmp_path / "sweep", progress=False
            )
    finally:
        for timer in timers:
            timer.cancel()
    assert (tmp_path / "sweep" / "results.jsonl").exists()


def test_a_figure_has_one_setting_along_and_the_others_tell_curves(table: transport.Sweep) -> None:
    """A map needs two settings with numbers; other kinds are refused."""
    with pytest.raises(
        transport.ArgumentError, match="kind: expected 'curves' or 'map', got 'pie'"
    ):
        table.plot(kind="pie")  # type: ignore[arg-type]  # the error of a user
    values: dict[str, list[Any]] = {
        "controller.disturbance.estimate": [False, True],
        "delay_s": [0.0, 0.1],
    }
    for grid in ({"delay_s": [0.0, 0.1]}, values):
        plan = swept_runs._plan({"a": base()}, grid, 1)
        results = [
            Result(key=case.key, outcome=ERROR, reason="", numbers={}) for case in plan.cases
        ]
        experiment = Experiment(name="sweep", points=tuple(plan.points))
        flown = transport.Sweep(Swept(experiment=experiment, cases=plan.cases, results=results))
        with pytest.raises(
            transport.ArgumentError, match="kind: expected two settings with numbers for a map, got"
        ):
            flown.plot(kind="map")
        drawn, measured = flown._drawn_as("delay_s", "curves")
        labels = [dict(one.point.labels) for one in measured]
        assert all(point.text for point in plan.points)
        if len(grid) == 1:
            assert (drawn.x, drawn.curves, labels) == (
                "delay_s",
                None,
                [{"delay_s": 0.0}, {"delay_s": 0.1}],
            )
        else:
            assert (drawn.x, drawn.curves, labels[-1]["delay_s"]) == ("delay_s", "settings", 0.1)
            assert str(labels[-1]["settings"]).endswith("True")

    several = Point({"delay_s": 0.1, "loss": 0.3, "speed_mps": 2.0}, "")
    assert swept_runs._relabelled(several, "delay_s", ["loss", "speed_mps"]).labels == {
        "delay_s": 0.1,
        "settings": "loss of plans 30 %, largest speed 2 m/s",
    }
