"""A sweep from its cases to its tables and figure: simulate the missing cases, keep each result, report all."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, Self

import orjson
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from protocol.wire.exit_codes import EXIT_CASE_FAILED
from transport.experiments.cases import Case, ExperimentError, Point, refused
from transport.experiments.declaration import Experiment, axis
from transport.experiments.figures import draw
from transport.experiments.simulation import ERROR, NUMBERS, RESOURCES, Result
from transport.experiments.statistics import PointStatistics, statistics_of
from transport.experiments.workers import on_cores
from transport.flight.progress import ConsoleProgress
from transport.flight.run_files import machine
from transport.report.report import write_csv, write_whole

_IDENTITY, _RESULTS = "experiment.json", "results.jsonl"


class Results:
    """Results by case; with a folder each is written to disk at once, and earlier ones are read from it.

    The machine is noted for the reader; ignored lines of the file are in `notices`.

    Raises: ExperimentError: the folder contains something else, or cannot be written.
    """

    def __init__(self, experiment: str, folder: Path | None = None) -> None:
        self.folder = folder
        self.notices: list[str] = []
        self._by_key: dict[str, Result] = {}
        self._file: BinaryIO | None = None
        if folder is None:
            return
        try:
            _identify(folder, experiment)
            self._file = (folder / _RESULTS).open("ab", buffering=0)
        except OSError as error:
            raise ExperimentError(f"--out: cannot write {folder} ({error.strerror})") from error
        self._read(folder / _RESULTS, self._file)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def __getitem__(self, key: str) -> Result:
        """Return the result of a simulated case."""
        return self._by_key[key]

    def done(self, key: str) -> bool:
        """Return whether a case has a result other than an error."""
        return key in self._by_key and self._by_key[key].outcome != ERROR

    def add(self, result: Result) -> None:
        """Keep a result."""
        if self._file is not None:
            self._file.write(orjson.dumps(asdict(result)) + b"\n")
        self._by_key[result.key] = result

    def _read(self, path: Path, file: BinaryIO) -> None:
        content = path.read_bytes()
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            file.truncate(whole)  # otherwise the next line would be appended to it
            self.notices.append(f"{path}: the last line is incomplete; its case is simulated again")
        for number, line in enumerate(content[:whole].splitlines(), start=1):
            try:
                result = Result(**orjson.loads(line))
                if result.outcome != ERROR:
                    itemgetter(*NUMBERS)(result.numbers)
                self._by_key[result.key] = result
            except (ValueError, TypeError, KeyError):
                self.notices.append(f"{path}: line {number} is no result of this version; its case is simulated again")


def _identify(folder: Path, experiment: str) -> None:
    """Note the experiment in its folder, or check that the folder belongs to it."""
    identity = folder / _IDENTITY
    folder.mkdir(parents=True, exist_ok=True)
    if identity.exists():
        found = orjson.loads(identity.read_bytes())["experiment"]
        got = "" if found == experiment else f"which belongs to {found}"
    else:
        got = "which contains other files" if any(folder.iterdir()) else ""
    if got:
        raise refused("--out", f"a new folder, or one of experiment {experiment}", f"{folder}, {got}")
    if not identity.exists():
        content = {"experiment": experiment, "machine": machine()}
        write_whole(identity, orjson.dumps(content, option=orjson.OPT_INDENT_2) + b"\n")


Simulate = Callable[[Sequence[Case]], Iterable[Result]]


@dataclass(frozen=True, kw_only=True)
class Swept:
    """An experiment with all its cases and their results, in the same order."""

    experiment: Experiment
    cases: Sequence[Case]
    results: Sequence[Result]

    @cached_property
    def measured(self) -> list[PointStatistics]:
        """Statistics of each point."""
        by_point: list[list[Result]] = [[] for _ in self.experiment.points]
        for case, result in zip(self.cases, self.results, strict=True):
            by_point[case.point].append(result)
        return statistics_of(self.experiment.points, by_point, self._numbers[1:])  # lost_s is in diverged_s

    @property
    def _numbers(self) -> tuple[str, ...]:
        return (*NUMBERS, *(RESOURCES if self.experiment.timed else ()))

    def rows(self, table: str) -> list[dict[str, Any]]:
        """Return a row for each point or, if the table is not "points", for each run; values by column."""
        if table == "points":
            return [m.row() for m in self.measured]
        rows = []
        for case, result in zip(self.cases, self.results, strict=True):
            point = self.experiment.points[case.point]
            own = {"seed": case.scenario.seed, "outcome": result.outcome, "reason": result.reason}
            rows.append({"scenario": point.scenario, **point.labels, **own, **result.numbers})
        return rows

    def write(self, folder: Path, *, shown: tuple[Experiment, Sequence[PointStatistics]] | None = None) -> list[Path]:
        """Write tables and figure to a folder and return the files; the figure may show another view of the sweep."""
        files = [self.write_cases(folder / "cases.csv"), *draw(*(shown or (self.experiment, self.measured)), folder)]
        points = folder / "points.csv"
        rows = self.rows("points")
        write_csv(points, rows, list(rows[0]))
        return [points, *files]

    def write_cases(self, file: Path) -> Path:
        """Write a row for each run and return the file; floats are written without loss."""
        columns = ["scenario", *self.experiment.points[0].labels, "seed", "outcome", "reason", *self._numbers]
        write_csv(file, self.rows("runs"), columns)
        return file

    def check(self) -> None:
        """Refuse a sweep with a run that raised an error.

        Raises: ExperimentError: naming the first.
        """
        failed = [result for result in self.results if result.outcome == ERROR]
        if failed:
            more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
            raise ExperimentError(f"a run raised an error{more}: {failed[0].reason}", EXIT_CASE_FAILED)


def sweep(
    experiment: Experiment, cases: Sequence[Case], simulate: Simulate, results: Results, console: Console
) -> Swept:
    """Simulate the cases without a result, and keep each result at once."""
    for notice in results.notices:
        console.print(notice, highlight=False, soft_wrap=True)
    every = {case.key: case for case in cases}
    # Seed by seed: a slow period of the machine affects the timing of all points alike.
    missing = sorted(
        (case for case in every.values() if not results.done(case.key)), key=lambda case: case.scenario.seed
    )
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
    return Swept(experiment=experiment, cases=cases, results=[results[case.key] for case in cases])


def simulated(name: str, groups: Sequence[Sequence[Case]], folder: Path | None = None) -> list[list[Result]]:
    """Simulate the cases of several points on all cores, and return the results of each point.

    Raises: ExperimentError: a run raised an error, a worker was lost, or the folder cannot be used.
    """
    cases = [replace(case, point=i) for i, group in enumerate(groups) for case in group]
    points = tuple(Point({}, group[0].scenario.name, scenario="run") for group in groups)
    with Results(name, folder) as results:
        experiment = Experiment(name=name, points=points, x=axis("point"))
        swept = sweep(experiment, cases, on_cores, results, Console(stderr=True))
    swept.check()
    found = iter(swept.results)
    return [[next(found) for _ in group] for group in groups]


class _Progress(ConsoleProgress):
    """Progress of a sweep on the console: the number of finished runs and the last result."""

    def __init__(self, name: str, done: int, total: int, console: Console) -> None:
        status = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[last]}"))
        super().__init__(console, TextColumn(name), *status, TimeElapsedColumn(), TimeRemainingColumn())
        self._done, self._total = done, total
        self._task = self._bar.add_task(name, total=total, completed=done, last="")

    def advance(self, last: str) -> None:
        """Count one more finished run, described with its outcome."""
        self._done += 1
        self._bar.update(self._task, completed=self._done, last=last)
        if self._is_line_due() or (self._done == self._total and not self._console.is_terminal):
            self.say(f"{self._done} of {self._total} runs done; last: {last}")
