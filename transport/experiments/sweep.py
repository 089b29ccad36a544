"""A sweep from its cases to its folder: simulate the missing cases, keep each result, write tables and figure."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from transport.experiments.cases import Case
from transport.experiments.errors import ExperimentError
from transport.experiments.experiment import Experiment
from transport.experiments.figures import draw
from transport.experiments.resource_use import RESOURCES
from transport.experiments.results import ResultsInMemory
from transport.experiments.simulation import NUMBERS, Result
from transport.experiments.statistics import PointStatistics, statistics_of
from transport.experiments.table import cases_csv, points_csv
from transport.flight.progress import ConsoleProgress
from transport.report.report import write_whole

Simulate = Callable[[Sequence[Case]], Iterable[Result]]


def sweep(
    experiment: Experiment, cases: Sequence[Case], simulate: Simulate, results: ResultsInMemory, console: Console
) -> list[Result]:
    """Simulate the cases without a result and keep each result at once; return all in the order of the cases."""
    for notice in results.notices:
        console.print(notice, highlight=False, soft_wrap=True)
    every = {case.key: case for case in cases}
    missing = [case for key, case in every.items() if not results.done(key)]
    # Seed by seed: a slow period of the machine affects the timing of all points alike.
    missing.sort(key=lambda case: case.scenario.seed)
    try:
        with _Progress(experiment.name, len(every) - len(missing), len(every), console) as progress:
            for result in simulate(missing) if missing else ():
                results.add(result)
                case = every[result.key]
                point = experiment.points[case.point]
                progress.advance(f"{point.scenario}, {point.text}, seed {case.scenario.seed}: {result.outcome}")
    except (KeyboardInterrupt, ExperimentError):
        done = sum(results.done(case.key) for case in cases)
        if results.folder is not None:
            hint = f"{done} of {len(cases)} runs are saved; resume with: --out {results.folder}"
            console.print(hint, highlight=False, soft_wrap=True)
        raise
    return [results[case.key] for case in cases]


def report(
    experiment: Experiment, cases: Sequence[Case], found: Sequence[Result], folder: Path
) -> tuple[list[PointStatistics], list[Path]]:
    """Write the tables and the figure of an experiment; return the statistics of its points, and the files."""
    by_point: list[list[Result]] = [[] for _ in experiment.points]
    for case, result in zip(cases, found, strict=True):
        by_point[case.point].append(result)
    numbers = (*NUMBERS, *(RESOURCES if experiment.timed else ()))
    measured = statistics_of(experiment.points, by_point, numbers[1:])  # lost_s is in PointStatistics.diverged_s
    tables = [folder / "points.csv", folder / "cases.csv"]
    write_whole(tables[0], points_csv(measured))
    write_whole(tables[1], cases_csv(experiment.points, cases, found, numbers))
    return measured, [*tables, *draw(experiment, measured, folder)]


class _Progress(ConsoleProgress):
    """Progress of a sweep on the console: the number of finished runs and the last result."""

    def __init__(self, name: str, done: int, total: int, console: Console) -> None:
        status = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[last]}"))
        super().__init__(console, TextColumn(name), *status, TimeElapsedColumn(), TimeRemainingColumn())
        self._done, self._total = done, total
        if self._bar is not None:
            self._task = self._bar.add_task(name, total=total, completed=done, last="")

    def advance(self, last: str) -> None:
        """Count one more finished run, described with its outcome."""
        self._done += 1
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, last=last)
        elif self._is_line_due() or self._done == self._total:
            self.say(f"{self._done} of {self._total} runs done; last: {last}")
