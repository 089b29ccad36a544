"""Sentences, tables and figures of an experiment, also with diverged runs."""

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from tests.support.figure_texts import problems
from transport.cli.commands.experiment import EXPERIMENTS
from transport.experiments.cases import Point
from transport.experiments.declaration import Experiment
from transport.experiments.figures.experiment_figures import draw, fill
from transport.experiments.result_tables import WIDTH, Column, markdown_of, table_of
from transport.experiments.run_numbers import NUMBERS
from transport.experiments.simulation import ERROR, Result
from transport.experiments.statistics import PointStatistics, statistics_of
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.report.figures.style import COLUMN_IN, RC, SMALL

BOTH = ("paper", "resilient")


def built(name: str, *of: str, **given: Any) -> Experiment:
    """Return an experiment of some scenarios, by default both."""
    scenarios = {one: read_scenario(find_scenario(one)) for one in of or BOTH}
    return EXPERIMENTS[name].experiment(scenarios, given)


LATENCY = built("latency", delay=[0.1, 0.4])
FURTHER = ("air_delivered_share", "airtime_share", "away_rms_m", "known_s")
RADIO = replace(EXPERIMENTS["radio"], points=tuple(EXPERIMENTS["radio"].build(
    max=8, sizes=[3, 4], rate=[6.0], offsets=["slots", "none"], sharing=["always"], distance=[1.0]
)))  # fmt: skip
HOVER = built("hover", "paper", "centralized", "resilient")
EVERY = (
    LATENCY,
    built("loss"),
    built("jitter", std=[0.02, 0.05]),
    built("kill"),
    built("deaths", "resilient"),
    built("sharing", "resilient"),
    built("ablation"),
    built("horizon", horizon=[5, 30], terminal=[1.0]),
    HOVER,
    RADIO,
    built("information", "precise", "resilient"),
    built("matrix", delay=[0.1, 0.2], loss=[0.1, 0.3]),
)


def completed(cost: float, attitude_deg: float) -> Result:
    """A completed run."""
    numbers: dict[str, float | None] = dict.fromkeys((*NUMBERS, *FURTHER), 0.5)
    numbers |= {"cost_mean": cost, "attitude_max_deg": attitude_deg, "lost_s": None}
    return Result(key="k", outcome="completed", reason="", numbers=numbers)


def diverged(at_s: float) -> Result:
    """A diverged run."""
    numbers: dict[str, float | None] = dict.fromkeys(NUMBERS, 0.5)
    return Result(key="k", outcome="diverged", reason="", numbers=numbers | {"lost_s": at_s})


def made(experiment: Experiment, results: Callable[[Point], list[Result]]) -> list[PointStatistics]:
    """Statistics of an experiment's points, with invented results."""
    names = (*NUMBERS[1:], *FURTHER)
    return statistics_of(experiment.points, [results(point) for point in experiment.points], names)


MIXES: dict[str, Callable[[Point], list[Result]]] = {
    "completed": lambda _: [completed(0.002, 1.0)],
    "repeated": lambda _: [
        completed(0.00123, 12.34),
        completed(0.00987, 1.0),
        completed(0.02, 3.0),
    ],
    "all diverged": lambda _: [diverged(14.35), diverged(20.0)],
    "some diverged": lambda point: [
        diverged(14.35) if point.scenario == "paper" else completed(0.002, 1.0),
        completed(0.003, 1.2),
    ],
    "errors": lambda _: [Result(key="k", outcome=ERROR, reason="why", numbers={})],
    "without cost": lambda _: [completed(0.0, 0.0)],
}


@pytest.mark.parametrize(
    ("experiment", "mix"),
    [
        *((experiment, "some diverged") for experiment in EVERY),
        *((LATENCY, mix) for mix in MIXES if mix != "some diverged"),
        *((EVERY[-1], mix) for mix in ("all diverged", "errors", "without cost")),
    ],
    ids=lambda value: value if isinstance(value, str) else value.name,
)
def test_anything_can_be_reported(experiment: Experiment, mix: str, tmp_path: Path) -> None:
    """Every mix of outcomes gives a table that fits its width, and a figure whose texts are large and apart."""
    measured = made(experiment, MIXES[mix])
    figure = Figure()
    with mpl.rc_context(RC):
        fill(figure, experiment, measured)
        assert problems(figure, SMALL) == []
    assert figure.get_figwidth() == COLUMN_IN
    assert all(
        axes.lines or axes.patches or axes.collections or axes.images for axes in figure.axes
    )
    first = [path.read_bytes() for path in draw(experiment, measured, tmp_path)]
    assert first[0].startswith(b"\x89PNG\r\n\x1a\n")
    assert b"<svg" in first[1]
    console = Console(width=WIDTH, record=True, file=io.StringIO())
    console.print(table_of(experiment.name, measured))
    text = console.export_text()
    assert "…" not in text
    assert max(len(line.rstrip()) for line in text.splitlines()) <= WIDTH


def test_every_column_of_a_table_has_its_unit() -> None:
    """Costs in thousandths, errors in cm, shares in %, plans in kB/s, over all kinds of tables."""
    numbers = {
        "cost_mean": 0.00123,
        "cost_max": 0.0123,
        "attitude_max_deg": 1.25,
        "swing_m": 0.125,
        "separation_min_m": 0.4567,
        "plan_age_mean_ticks": 2.5,
        "payload_rms_m": 0.0123,
        "payload_max_m": 0.0456,
        "away_rms_m": 0.034,
        "known_s": 3.25,
        "plans_shared_share": 0.456,
        "cpu_step_p50_ms": 1.75,
        "cpu_step_p99_ms": 2.75,
        "cpu_team_tick_ms": 725.4,  # large: without decimals
        "plan_bytes_per_s": 5678.0,
    }
    run = Result(key="k", outcome="completed", reason="", numbers={**numbers, "lost_s": None})
    ended = diverged(14.35)
    found: dict[str, str] = {}
    for label in ("case", "weather", "rule", "age_s", "share_threshold", "speed_mps", "ownership"):
        point = Point({label: 1.0}, "", scenario="a", baseline=True)
        measured = statistics_of([point], [[run, ended]], list(numbers))
        for column in table_of("", measured).columns:
            (cell,) = map(str, column.cells)
            assert found.setdefault(str(column.header), cell) == cell
    assert {name: found[name] for name in found if name not in ("scenario", "done")} == {
        "case": "1",
        "weather": "1",
        "rule": "1",
        "age\ns": "1",
        "share\nthreshold": "1",
        "speed\nmps": "1",
        "ownership": "1",
        "div.\n(s)": "14.3",
        "cost mean\n(1e-3)": "1.23",
        "cost\nratio": "1.00",
        "max\n(1e-3)": "12.3",
        "attitude\n(deg)": "1.25",
        "worst\n(deg)": "1.2",
        "swing\n(m)": "0.12",
        "apart\n(m)": "0.457",
        "age\n(tick)": "2.50",
        "error rms\n(cm)": "1.23",
        "largest\n(cm)": "4.6",
        "away rms\n(cm)": "3.4",
        "known\n(s)": "3.25",
        "plans\nsent (%)": "45.6",
        "CPU step\np50 (ms)": "1.75",
        "p99\n(ms)": "2.75",
        "team\n(ms)": "725",
        "plans\n(kB/s)": "5.7",
    }
    assert found["done"] == "1/2"


@pytest.mark.parametrize(
    ("value", "text"),
    [(99.994, "99.99"), (100.0, "100"), (-99.994, "-99.99"), (-100.4, "-100"), (None, "-")],
)
def test_large_numbers_have_no_decimals(value: float | None, text: str) -> None:
    """From a hundred on, of either sign; a missing number is a dash."""
    assert Column("", "x").cell({"x": value, "completed": 1}) == text


def test_a_table_has_the_columns_of_its_first_label_that_has_some() -> None:
    """A case that is flown at several speeds has errors; in Markdown a heading is one line, a cell may have several."""
    point = Point({"case": "wind", "speed_mps": 3.0}, "", scenario="a")
    table = table_of("", statistics_of([point], [[completed(0.1, 1.0)]], NUMBERS[1:]))
    assert "error rms\n(cm)" in [column.header for column in table.columns]

    lines = Table("a\nb", "c")
    lines.add_row("x\ny", "1")
    assert markdown_of(lines) == ["| a b | c |", "| --- | --- |", "| x<br>y | 1 |"]


@pytest.mark.parametrize("experiment", [LATENCY, HOVER], ids=lambda value: value.name)
def test_markers_stand_on_their_values(experiment: Experiment) -> None:
    """The points of a single curve in a panel are exactly at the values of their runs."""
    figure = Figure()
    with mpl.rc_context(RC):
        fill(figure, experiment, made(experiment, MIXES["repeated"]))
    for panel in figure.axes:
        values = {float(tick) for tick in panel.get_xticks()}
        for line in panel.lines:
            if line.get_marker() not in ("None", "", "_", "|"):
                assert set(np.asarray(line.get_xdata(), float).tolist()) <= values
