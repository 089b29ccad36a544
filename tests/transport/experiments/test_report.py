"""What is made of an experiment's numbers: sentences, tables, figures; also of flights that were lost."""

import io
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import pytest
from rich.console import Console

from transport.experiments import catalogue
from transport.experiments.cases import Point
from transport.experiments.catalogue import Experiment
from transport.experiments.figures import draw
from transport.experiments.findings import findings
from transport.experiments.flight import ERROR, NUMBERS, Result
from transport.experiments.statistics import Measured, measure
from transport.experiments.table import WIDTH, table_of

BOTH = ["paper", "resilient"]
LATENCY = catalogue.latency(BOTH, [0.1, 0.4])
EVERY = (
    LATENCY,
    catalogue.loss(BOTH, [0.1, 0.3, 0.6], 5.0),
    catalogue.jitter(BOTH, list(catalogue.JITTER), [0.02, 0.05], 0.16),
    catalogue.kill({"paper": 4, "resilient": 4}, 8.0, 10.0),
    catalogue.matrix(BOTH, [0.1, 0.2], [0.1, 0.3]),
)


def flown(cost: float, attitude_deg: float) -> Result:
    """A completed flight."""
    numbers: dict[str, float | None] = dict.fromkeys(NUMBERS, 0.5)
    numbers |= {"cost_mean": cost, "attitude_max_deg": attitude_deg, "lost_s": None}
    return Result(key="k", outcome="completed", reason="", numbers=numbers)


def lost(at_s: float) -> Result:
    """A diverged flight."""
    numbers: dict[str, float | None] = dict.fromkeys(NUMBERS, 0.5)
    return Result(key="k", outcome="diverged", reason="", numbers=numbers | {"lost_s": at_s})


def made(experiment: Experiment, results: Callable[[Point], list[Result]]) -> list[Measured]:
    """What an experiment's points say, with invented results."""
    return measure(experiment.points, [results(point) for point in experiment.points], NUMBERS[1:])


def test_findings_of_completed_flights() -> None:
    """Survival, the worst attitude and where, cost ratios against the flight without impairment."""

    def results(point: Point) -> list[Result]:
        delay_s = float(point.labels["delay_s"])
        return [flown(0.002 * (1.0 + delay_s), 1.0 + delay_s)]

    assert findings(made(LATENCY, results))[1] == (
        "resilient: completes all 3 points (3 of 3 flights); largest payload attitude 1.40 deg (400 ms); "
        "cost x1.10 (100 ms), x1.40 (400 ms)"
    )


def test_findings_of_lost_flights() -> None:
    """Lost points are named with the time; of repetitions how many were completed; errors are told apart."""

    def results(point: Point) -> list[Result]:
        if point.labels["delay_s"] == 0.0:
            return [flown(0.002, 1.0)]
        return [lost(14.3)] if point.labels["delay_s"] == 0.4 else [flown(0.003, 2.0), lost(9.0)]

    assert findings(made(LATENCY, results))[0] == (
        "paper: completes 2 of 4 flights, all but at 100 ms (1 of 2), 400 ms (lost at 14.3 s); "
        "largest payload attitude 2.00 deg (100 ms); cost x1.50 (100 ms)"
    )
    broken = [Result(key="k", outcome=ERROR, reason="", numbers={})]
    assert findings(made(LATENCY, lambda _: broken))[0] == ("paper: 3 flights could not be flown")


def test_findings_of_many_lost_flights() -> None:
    """Of more points than fit a sentence the earliest loss is named."""
    matrix = EVERY[-1]
    found = findings(made(matrix, lambda point: [lost(9.5 if point.text == "100 ms and 30 % loss" else 12.0)]))[0]
    count = "completes 0 of 9 flights, 0 of 9 points without a lost flight"
    assert found == f"paper: {count}; first lost at 9.5 s (100 ms and 30 % loss)"


MIXES: dict[str, Callable[[Point], list[Result]]] = {
    "completed": lambda _: [flown(0.002, 1.0)],
    "repeated": lambda _: [flown(0.00123, 12.34), flown(0.00987, 1.0), flown(0.02, 3.0)],
    "all lost": lambda _: [lost(14.35), lost(20.0)],
    "some lost": lambda point: [lost(14.35) if point.scenario == "paper" else flown(0.002, 1.0), flown(0.003, 1.2)],
    "errors": lambda _: [Result(key="k", outcome=ERROR, reason="why", numbers={})],
    "without cost": lambda _: [flown(0.0, 0.0)],
}


@pytest.mark.parametrize(
    ("experiment", "mix"),
    [
        *((experiment, mix) for experiment in EVERY for mix in ("repeated", "some lost")),
        *((experiment, mix) for experiment in (EVERY[1], EVERY[-1]) for mix in ("all lost", "errors", "without cost")),
        (LATENCY, "completed"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.name,
)
def test_anything_can_be_reported(experiment: Experiment, mix: str, tmp_path: Path) -> None:
    """Whatever the flights came to there is a figure and a table that fits its width."""
    measured = made(experiment, MIXES[mix])
    first = [path.read_bytes() for path in draw(experiment, measured, tmp_path)]
    assert first[0].startswith(b"\x89PNG\r\n\x1a\n")
    assert b"<svg" in first[1]
    console = Console(width=WIDTH, record=True, file=io.StringIO())
    console.print(table_of(experiment.name, measured))
    text = console.export_text()
    assert "…" not in text
    assert max(len(line.rstrip()) for line in text.splitlines()) <= WIDTH


def test_figures_are_reproducible(tmp_path: Path) -> None:
    """Equal numbers give equal files, and no setting of matplotlib is changed."""
    before = dict(mpl.rcParams)
    measured = made(LATENCY, MIXES["repeated"])
    first = [path.read_bytes() for path in draw(LATENCY, measured, tmp_path)]
    assert [path.read_bytes() for path in draw(LATENCY, measured, tmp_path)] == first
    assert dict(mpl.rcParams) == before
