"""Experiments of docs/record/results.md with their runs, texts and figures; and the figures of single runs."""

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from measured import Measured
from readme_tables import ALONE, TEAM, worth
from tables import ROOT

from transport.cli.commands.experiment import EXPERIMENTS as DECLARED
from transport.cli.commands.experiment import ExperimentOptions
from transport.experiments.cases import Case
from transport.experiments.declaration import Experiment
from transport.experiments.paper import comparison_report
from transport.experiments.paper.comparison_report import ComparisonOptions, ComparisonPlan
from transport.experiments.paper.controllers_and_periods import DECLARED as COMPARISON
from transport.experiments.result_sentences import conclusions
from transport.experiments.result_tables import markdown, table_of
from transport.experiments.simulation import Result
from transport.experiments.sweep import Swept

IMAGES = ROOT / "docs" / "images"
PAGE = ROOT / "docs" / "record" / "results.md"

# Network of the README's animation.
NETWORK = ("--set", "links.delay_s=0.2", "--set", "links.loss=0.3")

Row = Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Asked:
    """Options of an experiment where they are not the defaults.

    Attributes:
        own: Its own options.
        seeds: Repetitions of random runs.
        declared: Name of its declaration, if that is another one: part of an experiment with more seeds.
        scenarios: Scenarios.
        shown: Returns the text of the page in place of conclusions and table, from the rows of points.csv.
    """

    own: Mapping[str, Any] = field(default_factory=dict)
    seeds: int | None = None
    declared: str = ""
    scenarios: Sequence[str] = ()
    shown: Callable[[Sequence["Row"]], str] | None = None

    def plan(self, name: str) -> tuple[Experiment, list[Case]]:
        """Return the experiment with its runs."""
        options = ExperimentOptions(
            declared=DECLARED[self.declared or name],
            seeds=self.seeds,
            scenarios=list(self.scenarios) or None,
        )
        return options.plan(self.own, simulated_before=True)


# Standard deviation of gusts in the comparison, m/s.
GUST_MPS = 1.0
PAPER, WEATHER = "paper", "weather"
EXPERIMENTS: Mapping[str, Asked] = {
    **dict.fromkeys(
        ("paper", "latency", "loss", "jitter", "matrix", "kill", "deaths", "sharing"), Asked()
    ),
    **dict.fromkeys(("ablation", "horizon", "hover"), Asked()),
    "agile": Asked({"speed": [5.0, 6.0]}, seeds=1),
    "scaling": Asked({"max": 12}, seeds=3),
    "radio": Asked({"sharing": ["always", "on_change"]}, seeds=1),
    WEATHER: Asked(seeds=2),
    "worth": Asked(
        {"air": ["still air", "gusts 2 m/s"]},
        seeds=5,
        declared=WEATHER,
        scenarios=(TEAM, ALONE),
        shown=worth,
    ),
    "information": Asked(seeds=10),
    "follow": Asked(seeds=10),
}
# Pages of experiments with a page of their own.
OWN_PAGES = {"radio": ROOT / "docs" / "record" / "radio.md"}


def swept(experiment: Experiment, cases: Sequence[Case], results: Sequence[Result]) -> Swept:
    """Return a sweep with its results."""
    return Swept(experiment=experiment, cases=cases, results=results)


def page_of(name: str) -> Path:
    """Return the page of an experiment."""
    return OWN_PAGES.get(name, PAGE)


def measured(name: str) -> Measured:
    """Return an experiment as a part of the page."""
    if name == PAPER:
        return _compared()
    asked = EXPERIMENTS[name]
    experiment, cases = asked.plan(name)

    def text(results: Sequence[Result]) -> str:
        if asked.shown is not None:
            return f"{asked.shown(rows_of(name, results))}\n"
        found = swept(experiment, cases, results).measured
        return markdown(conclusions(found), table_of("", found))

    def draw(results: Sequence[Result]) -> None:
        if asked.shown is not None:  # the whole experiment has the figure
            return
        with tempfile.TemporaryDirectory() as folder:
            swept(experiment, cases, results).write(Path(folder))
            shutil.copy(Path(folder) / "figure.png", IMAGES / f"{name}.png")

    return Measured(
        name=name,
        document=page_of(name),
        cases=cases,
        texts=_texts(experiment, cases),
        text=text,
        draw=draw,
        is_timed=experiment.drawn_as == "scaling",
    )


def _texts(experiment: Experiment, cases: Sequence[Case]) -> list[str]:
    """Return each run of a sweep in words."""
    points = [experiment.points[case.point] for case in cases]
    return [f"{point.scenario}: {point.text}" for point in points]


def _comparison() -> ComparisonPlan:
    options = ComparisonOptions(settings=(), seeds=COMPARISON.seeds, gust_mps=GUST_MPS)
    return comparison_report.plan(options, simulated_before=True)


def _halves(planned: ComparisonPlan, results: Sequence[Result]) -> tuple[Swept, Swept]:
    """Return the timed runs of the comparison and those that give the costs."""
    count = len(planned.timed)
    return (
        swept(planned.measurement, planned.timed, results[:count]),
        swept(planned.experiment, planned.cases, results[count:]),
    )


def _compared() -> Measured:
    """Return the comparison of the paper as a part of the page."""
    planned = _comparison()

    def text(results: Sequence[Result]) -> str:
        result = comparison_report.compared(planned, *_halves(planned, results))
        return markdown(result.sentences, result.table)

    def draw(results: Sequence[Result]) -> None:
        timed, costs = _halves(planned, results)
        result = comparison_report.compared(planned, timed, costs)
        with tempfile.TemporaryDirectory() as folder:
            comparison_report.draw(result, planned, costs, Path(folder))
            shutil.copy(Path(folder) / "figure.png", IMAGES / "paper.png")
            shutil.copy(Path(folder) / "maneuver.png", IMAGES)

    return Measured(
        name=PAPER,
        document=PAGE,
        cases=[*planned.timed, *planned.cases],
        texts=[
            *(f"timed, {text}" for text in _texts(planned.measurement, planned.timed)),
            *_texts(planned.experiment, planned.cases),
        ],
        text=text,
        draw=draw,
        is_timed=True,
    )


def rows_of(name: str, results: Sequence[Result]) -> list[dict[str, str]]:
    """Return the rows of points.csv of an experiment as texts."""
    rows = swept(*EXPERIMENTS[name].plan(name), results).rows("points")
    return [_as_text(row) for row in rows]


def ranges_of_comparison(results: Sequence[Result]) -> list[dict[str, str]]:
    """Return the rows of ranges.csv of the comparison of the paper as texts."""
    planned = _comparison()
    result = comparison_report.compared(planned, *_halves(planned, results))
    return [_as_text(row) for row in result.range_rows]


def _as_text(row: Mapping[str, Any]) -> dict[str, str]:
    return {name: "" if value is None else str(value) for name, value in row.items()}


def _transport(*arguments: str) -> None:
    """Run a command of the project."""
    command = [sys.executable, "-P", "-m", "transport", *arguments]
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True, cwd=ROOT)


def figures_of_runs() -> None:
    """Copy the figures of the paper's maneuver.

    Animate fast flight on a late network for the README.
    """
    with tempfile.TemporaryDirectory() as folder:
        run, animated = Path(folder) / "run", Path(folder) / "animation"
        _transport("run", "paper", "--out", str(run))
        for figure in (run / "figures").glob("*.png"):
            shutil.copy(figure, IMAGES / figure.name)
        _transport("run", "eight", *NETWORK, "--no-figures", "--out", str(animated))
        _transport("plot", str(animated), "--animate", str(IMAGES / "flight.gif"))
