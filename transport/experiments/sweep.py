"""An experiment from its cases to its folder: fly what is missing, keep each result, write tables and figure."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from rich.console import Console

from transport.experiments.cases import Case
from transport.experiments.catalogue import Experiment
from transport.experiments.effort import EFFORT
from transport.experiments.figures import draw
from transport.experiments.flight import NUMBERS, Result
from transport.experiments.progress import SweepProgress
from transport.experiments.results import Results
from transport.experiments.statistics import Measured, measure
from transport.experiments.table import cases_csv, points_csv
from transport.report.report import write_whole

Fly = Callable[[Sequence[Case]], Iterable[Result]]


def sweep(
    experiment: Experiment, cases: Sequence[Case], simulate: Fly, results: Results, console: Console
) -> list[Result]:
    """Fly the cases that are not done yet; each result is kept as soon as it is there.

    Args:
        experiment: What they belong to.
        cases: All of its flights.
        simulate: Gives the results of cases, in any order.
        results: What is done already, and where to keep the rest.
        console: Where progress is drawn.
    Returns: The results in the order of the cases, whatever was flown where and when.
    """
    every = {case.key: case for case in cases}
    missing = [case for key, case in every.items() if not results.done(key)]
    # Round by round: when the machine is slow for a while, timing suffers at every point and not at one.
    missing.sort(key=lambda case: case.scenario.seed)
    with SweepProgress(experiment.name, len(every) - len(missing), len(every), console) as progress:
        for result in simulate(missing) if missing else ():
            results.add(result)
            case = every[result.key]
            point = experiment.points[case.point]
            progress.advance(f"{point.scenario}, {point.text}, seed {case.scenario.seed}: {result.outcome}")
    return [results[case.key] for case in cases]


def report(
    experiment: Experiment, cases: Sequence[Case], found: Sequence[Result], folder: Path
) -> tuple[list[Measured], list[Path]]:
    """Write the tables and the figure of an experiment, anew if they are there.

    Args:
        experiment: What was flown.
        cases: Its flights.
        found: What came of each.
        folder: Of the experiment.
    Returns: What each point's flights say, and the files.
    """
    by_point: list[list[Result]] = [[] for _ in experiment.points]
    for case, result in zip(cases, found, strict=True):
        by_point[case.point].append(result)
    numbers = (*NUMBERS, *(EFFORT if experiment.timed else ()))
    measured = measure(experiment.points, by_point, numbers[1:])  # when flights were lost has a place of its own
    tables = [folder / "points.csv", folder / "cases.csv"]
    write_whole(tables[0], points_csv(measured))
    write_whole(tables[1], cases_csv(experiment.points, cases, found, numbers))
    return measured, [*tables, *draw(experiment, measured, folder)]
