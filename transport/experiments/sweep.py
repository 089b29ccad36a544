"""Sweep from its cases to its tables and figure.

Cases without a result are simulated, each result is kept, and all are reported.
"""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import msgspec
import orjson
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from transport.experiments.cases import Case, ExperimentError, refused
from transport.experiments.declaration import Experiment
from transport.experiments.figures.experiment_figures import draw
from transport.experiments.run_numbers import NUMBERS
from transport.experiments.simulation import ERROR, Result
from transport.experiments.statistics import PointStatistics, statistics_of
from transport.flight.progress import ConsoleProgress, compile_models
from transport.protocol.scenario.files.atomic_writing import PARTIAL, Lines, write_csv, write_whole
from transport.protocol.wire.errors_and_exit_codes import EXIT_FAILED, TransportError

# Files of a folder: the experiment to which it belongs, and the results.
_IDENTITY = "experiment.json"
_RESULTS = "results.jsonl"


class Results:
    """Results by case; with a folder each is written to disk at once.

    Earlier results are read from the folder. Lines of the file that are incomplete or of another
    version are ignored: their cases are simulated again.

    Attributes:
        earlier: Keys of the cases that were done before, in the folder.

    Raises: ExperimentError: the folder contains something else, or cannot be written.
    """

    def __init__(self, experiment: str, folder: Path | None = None) -> None:
        self.folder = folder
        self.earlier: frozenset[str] = frozenset()
        self._by_key: dict[str, Result] = {}
        self._file: Lines | None = None
        if folder is None:
            return

        try:
            _identify(folder, experiment)
            self._file = Lines(folder / _RESULTS)
        except OSError as error:
            raise ExperimentError(f"--out: cannot write {folder} ({error.strerror})") from error
        for line in self._file.read():
            with suppress(ValueError):
                self._take(msgspec.json.decode(line, type=Result))
        self.earlier = frozenset(filter(self.done, self._by_key))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def __getitem__(self, key: str) -> Result:
        """Return the result of a simulated case."""
        return self._by_key[key]

    def __contains__(self, key: str) -> bool:
        """Return whether a case has a result, perhaps an error."""
        return key in self._by_key

    def done(self, key: str) -> bool:
        """Return whether a case has a result other than an error."""
        return key in self._by_key and self._by_key[key].outcome != ERROR

    def add(self, result: Result) -> None:
        """Keep a result."""
        if self._file is not None:
            self._file.add(orjson.dumps(asdict(result)))
        self._by_key[result.key] = result

    def _take(self, result: Result) -> None:
        """Take in a result from the folder, unless it lacks numbers."""
        if result.outcome == ERROR or result.numbers.keys() >= set(NUMBERS):
            self._by_key[result.key] = result


def _identify(folder: Path, experiment: str) -> None:
    """Note the experiment in its folder, or check that the folder belongs to it."""
    identity = folder / _IDENTITY
    folder.mkdir(parents=True, exist_ok=True)
    content_names = {path.name for path in folder.iterdir()}
    if content_names <= {_IDENTITY + PARTIAL}:  # nothing, or the part that a kill has left
        write_whole(identity, orjson.dumps({"experiment": experiment}) + b"\n")

    content = "other files"
    with suppress(FileNotFoundError, orjson.JSONDecodeError, KeyError, TypeError):
        content = f"experiment {orjson.loads(identity.read_bytes())['experiment']}"
    if content != f"experiment {experiment}":
        expected = f"a new folder, or one of experiment {experiment}"
        raise refused("--out", expected, f"{folder}, which contains {content}")


Simulate = Callable[[Sequence[Case]], Iterable[Result]]


@dataclass(frozen=True, kw_only=True)
class Swept:
    """An experiment with all its cases and their results, in the same order."""

    experiment: Experiment
    cases: Sequence[Case]
    results: Sequence[Result]

    @cached_property
    def by_point(self) -> list[list[Result]]:
        """Results of each point."""
        by_point: list[list[Result]] = [[] for _ in self.experiment.points]
        for case, result in zip(self.cases, self.results, strict=True):
            by_point[case.point].append(result)
        return by_point

    @cached_property
    def measured(self) -> list[PointStatistics]:
        """Statistics of each point."""
        names = [name for name in self._numbers if name != "lost_s"]  # which is in diverged_s
        return statistics_of(self.experiment.points, self.by_point, names)

    @property
    def _numbers(self) -> list[str]:
        """Names of the numbers of all results."""
        further = [name for result in self.results for name in result.numbers]
        return list(dict.fromkeys([*NUMBERS, *further]))

    def rows(self, table: str) -> list[dict[str, Any]]:
        """Return a row for each point or, if the table is not "points", for each run.

        Rows are values by column.
        """
        if table == "points":
            return [one.row() for one in self.measured]

        rows = []
        for case, result in zip(self.cases, self.results, strict=True):
            point = self.experiment.points[case.point]
            own = {"seed": case.scenario.seed, "outcome": result.outcome, "reason": result.reason}
            rows.append({"scenario": point.scenario, **point.labels, **own, **result.numbers})
        return rows

    def write(
        self, folder: Path, *, shown: tuple[Experiment, Sequence[PointStatistics]] | None = None
    ) -> list[Path]:
        """Write tables and figure to a folder and return the files.

        The figure may show another view of the sweep.
        """
        experiment, measured = shown or (self.experiment, self.measured)
        cases = self.write_cases(folder / "cases.csv")
        figures = draw(experiment, measured, folder)

        points = folder / "points.csv"
        rows = self.rows("points")
        write_csv(points, rows, list(rows[0]))
        return [points, cases, *figures]

    def write_cases(self, file: Path) -> Path:
        """Write a row for each run and return the file; floats are written without loss."""
        labels = self.experiment.points[0].labels
        columns = ["scenario", *labels, "seed", "outcome", "reason", *self._numbers]
        write_csv(file, self.rows("runs"), columns)
        return file

    def check(self) -> None:
        """Refuse a sweep with a run that raised an error.

        Raises: ExperimentError: naming the first.
        """
        failed = [result for result in self.results if result.outcome == ERROR]
        if failed:
            more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
            raise ExperimentError(f"a run raised an error{more}: {failed[0].reason}", EXIT_FAILED)


def sweep(
    experiment: Experiment,
    cases: Sequence[Case],
    simulate: Simulate,
    results: Results,
    console: Console,
) -> Swept:
    """Simulate the cases without a result, and keep each result at once; say how many were done before."""
    by_key = {case.key: case for case in cases}
    # Seed by seed: a slow period of the machine affects the timing of all points alike.
    missing = [case for case in by_key.values() if not results.done(case.key)]
    missing.sort(key=lambda case: case.scenario.seed)
    done = len(by_key) - len(missing)
    earlier = sum(case.key in results.earlier for case in cases)
    if earlier:
        text = f"{earlier} of {len(cases)} runs are done already"
        console.print(text, highlight=False, soft_wrap=True)
    # Once, not in each worker.
    compile_models((case.scenario for case in missing), console)

    try:
        with _Progress(experiment.name, done, len(by_key), console) as progress:
            for result in simulate(missing) if missing else ():
                results.add(result)
                case = by_key[result.key]
                point = experiment.points[case.point]
                run = f"{point.scenario}, {point.text}, seed {case.scenario.seed}"
                progress.advance(f"{run}: {result.outcome}")
    except (KeyboardInterrupt, TransportError):
        saved = sum(results.done(case.key) for case in cases)
        if results.folder is not None:
            hint = f"{saved} of {len(cases)} runs are saved; resume with: --out {results.folder}"
            console.print(hint, highlight=False, soft_wrap=True)
        raise

    return Swept(experiment=experiment, cases=cases, results=[results[case.key] for case in cases])


class _Progress(ConsoleProgress):
    """Progress of a sweep on the console: the number of finished runs and the last result."""

    def __init__(self, name: str, done: int, total: int, console: Console) -> None:
        columns = (
            TextColumn(name),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[last]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        super().__init__(console, *columns)
        self._task = self._bar.add_task(name, total=total, completed=done, last="")

    def advance(self, last: str) -> None:
        """Count one more finished run, described with its outcome."""
        self._bar.update(self._task, advance=1, last=last)
        (task,) = self._bar.tasks
        is_end_due = task.finished and not self._console.is_terminal
        if self._is_line_due() or is_end_due:
            self.say(f"{task.completed:g} of {task.total:g} runs done; last: {last}")
