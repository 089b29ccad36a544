"""Experiments of docs/record/results.md and the tables and figures of README made from them."""

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from measured import Derived, Measured
from readme_tables import ALONE, TEAM, drag, known, worth
from tables import ROOT, table

from transport.cli.commands.experiment import EXPERIMENTS as DECLARED
from transport.cli.commands.experiment import ExperimentOptions
from transport.experiments.cases import Case, Result
from transport.experiments.conclusions import conclusions
from transport.experiments.declaration import Experiment
from transport.experiments.paper import comparison_report
from transport.experiments.paper.comparison import DECLARED as COMPARISON
from transport.experiments.paper.comparison_report import ComparisonOptions, ComparisonPlan
from transport.experiments.result_tables import table_of
from transport.experiments.sweep import Swept, markdown

IMAGES = ROOT / "docs" / "images"
PAGE, README = ROOT / "docs" / "record" / "results.md", ROOT / "README.md"

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
            return f"{asked.shown(_rows(name, results))}\n"
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


def _rows(name: str, results: Sequence[Result]) -> list[dict[str, str]]:
    """Return the rows of points.csv of an experiment as texts."""
    rows = swept(*EXPERIMENTS[name].plan(name), results).rows("points")
    return [_as_text(row) for row in rows]


def _as_text(row: Mapping[str, Any]) -> dict[str, str]:
    return {name: "" if value is None else str(value) for name, value in row.items()}


def between(values: Sequence[float]) -> str:
    """Return the range of values, two digits each; a single value if both ends round to the same."""
    return " to ".join(dict.fromkeys(f"{end:.2f}" for end in (min(values), max(values))))


# Rows of the table on the network at a glance: text, experiment, and labels of the points.
GLANCE: Sequence[tuple[str, str, Row]] = (
    ("`transport experiment latency`: 100 ms delay", "latency", {"delay_s": "0.1"}),
    ("400 ms delay", "latency", {"delay_s": "0.4"}),
    (
        "`transport experiment loss`: 10 % packet loss",
        "loss",
        {"loss": "0.1", "model": "bernoulli"},
    ),
    ("60 % burst loss", "loss", {"loss": "0.6", "model": "bursts"}),
    (
        "`transport experiment kill`: an agent killed and restarted after 2 s",
        "kill",
        {"restart_s": "10.0"},
    ),
    ("never restarted", "kill", {"restart_s": "never"}),
    ("`transport experiment deaths`: killed for good at 20 random times", "deaths", {}),
)


def at_a_glance(results: Mapping[str, Sequence[Result]]) -> str:
    """Return the table at a glance: effect of the network on the two algorithms."""
    tables = {name: _rows(name, own) for name, own in results.items()}
    rows = [
        [text, *(_effect(tables[name], {"scenario": scenario, **labels}) for scenario in SCENARIOS)]
        for text, name, labels in GLANCE
    ]
    return table(["", "`paper`: the paper's algorithm with our weights", "`resilient`"], rows)


SCENARIOS = ("paper", "resilient")


def _effect(rows: Sequence[Row], labels: Row) -> str:
    """Return how the runs with some labels end, in words; ranges are over the points of the experiment."""
    own = [row for row in rows if row.items() >= labels.items() and row.get("agent") != "none"]
    if not own:
        return ""
    runs = sum(int(row["flights"]) for row in own)
    completed = sum(int(row["completed"]) for row in own)
    if not completed:
        first_s = min(float(row["first_lost_s"]) for row in own)
        return f"{completed} of {runs} complete, the first diverges at {first_s:.1f} s"

    done = [row for row in own if row["cost_ratio"]]
    if not done:
        return f"{completed} of {runs} complete"
    ratios = [float(row["cost_ratio"]) for row in done]
    attitude_deg = max(float(row["attitude_max_deg"]) for row in done)
    swings_m = [float(row["swing_m"]) for row in done]
    effect = (
        f"cost x{between(ratios)}, attitude {attitude_deg:.1f} deg, swing {between(swings_m)} m"
    )
    return f"{completed} of {runs} complete: {effect}"


def claim(results: Mapping[str, Sequence[Result]]) -> str:
    """Return the table of the paper's algorithm against the centralized controller.

    One row a comparison.
    """
    planned = _comparison()
    result = comparison_report.compared(planned, *_halves(planned, results[PAPER]))
    rows = [_as_text(row) for row in result.range_rows]
    rows = [row for row in rows if row["controller"] == "paper's algorithm"]
    weathers = list(dict.fromkeys(row["weather"] for row in rows))
    cells = {(row["at"], row["weather"]): row["cost"] or row["T_s"] for row in rows}
    periods: dict[str, str] = {}
    for row in rows:  # of the first weather
        periods.setdefault(row["at"], f" (T_s {row['T_s']})" * bool(row["cost"]))
    lines = [
        [f"at {at}{where}", *(cells[at, weather] for weather in weathers)]
        for at, where in periods.items()
    ]
    return table(["the paper's algorithm with our weights", *weathers], lines)


DERIVED = (
    Derived(
        name="drag",
        document=README,
        sources=("fast",),
        text=lambda results: drag(results["fast"]),
    ),
    Derived(
        name="known",
        document=README,
        sources=("information",),
        text=lambda results: known(_rows("information", results["information"])),
    ),
    Derived(
        name="network",
        document=PAGE,
        sources=("latency", "loss", "kill", "deaths"),
        text=at_a_glance,
    ),
    Derived(name="claim", document=PAGE, sources=(PAPER,), text=claim),
)


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
