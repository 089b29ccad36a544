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

from tests.support.figure_texts import problems
from transport.cli.commands.experiment import EXPERIMENTS
from transport.experiments.cases import Point
from transport.experiments.declaration import Experiment
from transport.experiments.figures.experiment_figures import draw, fill
from transport.experiments.result_tables import WIDTH, table_of
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
