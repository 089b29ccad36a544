"""Report of the arena: a table for each axis, one file with results and versions, and the figure."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import matplotlib as mpl
import orjson
import tomli_w
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from transport.experiments.arena.arena_measures import MEASURES, MISSING, judged
from transport.experiments.arena.arena_runs import NAME, ArenaRuns
from transport.experiments.arena.arena_tasks_and_networks import (
    NETWORK_TEXTS,
    NETWORKS,
    TASKS,
    VERSION,
)
from transport.experiments.cases import Case
from transport.experiments.figures.figure_arena import draw_measure
from transport.experiments.result_tables import SPREAD, markdown_of
from transport.experiments.statistics import COST_RATIO, PointStatistics, columns_of
from transport.experiments.sweep import Results, Simulate, Swept, sweep
from transport.flight.run_files import machine, versions
from transport.protocol.scenario.files.atomic_writing import write_whole
from transport.report.figures.style import RC, save

RESULTS = "arena.json"
_REFUSED = "no"
_TITLE_WIDTH = 60  # characters, of the longest title
# Folder of the scenarios that were not completed.
_ENDED = "ended"


@dataclass(frozen=True)
class ArenaResult:
    """The arena with the results of its runs."""

    arena: ArenaRuns
    swept: Swept

    @cached_property
    def by_place(self) -> Mapping[tuple[str, str, str], tuple[PointStatistics, str]]:
        """Statistics of each point, and why it cannot be flown, by task, network and algorithm."""
        places = {}
        for index, one in enumerate(self.swept.measured):
            labels = one.point.labels
            place = (str(labels["task"]), str(labels["network"]), str(labels["algorithm"]))
            places[place] = one, self.arena.refused.get(index, "")
        return places

    @property
    def tasks(self) -> list[str]:
        """Names of the tasks."""
        return list(dict.fromkeys(task for task, _, _ in self.by_place))

    @property
    def tasks_that_tell_apart(self) -> list[str]:
        """Names of the tasks that not all algorithms complete on all networks, or of all if there are none."""
        missed = [
            task
            for (task, _, _), (one, refused) in self.by_place.items()
            if refused or one.errors or one.completed < one.runs
        ]
        return [task for task in self.tasks if task in missed] or self.tasks

    def tables(self) -> list[Table]:
        """Return the table of completed runs, and one for each measure of which a point has a number."""
        shown = self.tasks_that_tell_apart
        completed = self._table(
            "Completed runs; earliest end of the others", shown, _completed_in_words
        )
        others = [task for task in self.tasks if task not in shown]
        if others:
            completed.add_row(f"every one, on {', '.join(others)}", "every one", "all complete")

        flown = [one for one, refused in self.by_place.values() if not refused]
        measures = [
            self._table(axis.title, self.tasks, axis.text)
            for axis in MEASURES.values()
            if any(axis.text(one) != MISSING for one in flown)
        ]
        return [completed, *measures]

    def _table(
        self, title: str, tasks: Sequence[str], text: Callable[[PointStatistics], str]
    ) -> Table:
        """Return a table of some tasks: a row for each algorithm, in each cell a line for each network."""
        table = Table(box=None, title=title, padding=(0, 1, 0, 0), min_width=_TITLE_WIDTH)
        table.title_justify = "left"
        for heading in ("algorithm", "network", *tasks):
            table.add_column(heading, no_wrap=True)

        for algorithm in self.arena.algorithms:
            own_networks = [net for _, net, name in self.by_place if name == algorithm]
            networks = list(dict.fromkeys(own_networks))
            cells = []
            for task in tasks:
                points = [self.by_place[task, net, algorithm] for net in networks]
                cells.append([_REFUSED if refused else text(one) for one, refused in points])
            table.add_row(algorithm, *map("\n".join, [networks, *cells]))
        return table

    def sentences(self) -> list[str]:
        """Return what was tuned for each algorithm, and what cannot be flown and why."""
        tuned = [
            f"{name}{f' (version {one.version})' if one.version else ''}: tuned: {one.tuned}"
            for name, one in self.arena.algorithms.items()
        ]
        reasons: dict[str, list[str]] = {}
        for (task, network, name), (_, reason) in self.by_place.items():
            if reason:
                reasons.setdefault(f"{name}: {reason}", []).append(f"{task} on {network}")
        impossible = [
            f"no: {reason}: {', '.join(places)}" for reason, places in sorted(reasons.items())
        ]
        return [*tuned, *impossible]

    def content(self) -> dict[str, Any]:
        """Return results and versions as JSON data."""
        return {
            "arena": VERSION,
            "versions": versions(),
            "machine": machine(),
            "seeds": self.arena.seeds,
            "tasks": {name: asdict(TASKS[name]) for name in self.tasks},
            "networks": {name: NETWORKS[name] for name in NETWORKS},
            "algorithms": {name: asdict(one) for name, one in self.arena.algorithms.items()},
            "points": [_row(one, reason) for one, reason in self.by_place.values()],
        }

    def draw(self, measure: str, folder: Path) -> list[Path]:
        """Draw one of `MEASURES` to a folder as figure-MEASURE, and return the files."""
        axis = MEASURES[measure]
        with mpl.rc_context({**RC, "svg.hashsalt": f"{NAME} {measure}"}):
            figure = Figure()
            draw_measure(figure, self.swept.measured, axis.number, axis.drawn, axis.factor)
            return save(figure, folder / f"figure-{measure}.png")

    def write(self, folder: Path, measures: Sequence[str] = ()) -> list[Path]:
        """Write tables, results and figures to a folder and return the files."""
        files = self.swept.write(folder)
        files += [file for measure in measures for file in self.draw(measure, folder)]
        results = folder / RESULTS
        text = orjson.dumps(self.content(), option=orjson.OPT_INDENT_2, default=str)
        write_whole(results, text + b"\n")
        report = folder / "report.md"
        write_whole(report, self.markdown().encode())
        return [results, *files, report, *self._write_ended(folder / _ENDED)]

    def _write_ended(self, folder: Path) -> list[Path]:
        """Write the first run of each point that was not completed as a scenario; return the files.

        `transport run` flies it again, with figures and log.
        """
        ended: dict[int, Case] = {}
        for case, result in zip(self.swept.cases, self.swept.results, strict=True):
            if result.outcome != "completed":
                ended.setdefault(case.point, case)
        if ended:
            folder.mkdir(exist_ok=True)

        files = []
        for index, point in enumerate(self.arena.experiment.points):
            words = "-".join(map(str, point.labels.values()))
            name = "".join(letter if letter.isalnum() else "-" for letter in words)
            file = folder / f"{name}.toml"
            if index in ended:
                write_whole(file, tomli_w.dumps(ended[index].scenario.tree()))
                files.append(file)
            else:
                file.unlink(missing_ok=True)  # of the runs before this one was resumed
        with suppress(OSError):
            folder.rmdir()  # empty
        return files

    def markdown(self) -> str:
        """Return tables and sentences in Markdown."""
        lines = []
        for table in self.tables():
            lines += [f"**{table.title}**", "", *markdown_of(table), ""]
        lines += [f"- {sentence}" for sentence in self.sentences()]
        shown = dict.fromkeys(network for _, network, _ in self.by_place)
        lines += [f"- {network}: {NETWORK_TEXTS[network]}" for network in shown]
        count = self.arena.seeds
        seeds = f"{count} seed{'s' * (count > 1)} of each random run"
        if count > 1:
            seeds += f", {SPREAD}"
        origin = f"Arena {VERSION}, {seeds}; {versions()}; machine: {machine()}"
        return "\n".join([*lines, "", f"*{origin}*", ""])


def conduct(
    made: ArenaRuns, simulate: Simulate, folder: Path | None, console: Console
) -> ArenaResult:
    """Simulate the cases of the arena that have no result yet; a folder is resumed.

    Raises: ExperimentError: a worker was lost. KeyboardInterrupt: the finished runs are kept.
    """
    with Results(NAME, folder) as results:
        swept = sweep(made.experiment, made.cases, simulate, results, console)
    return ArenaResult(made, replace(swept, results=[*map(judged, swept.results)]))


def _completed_in_words(one: PointStatistics) -> str:
    """Return how many runs complete, when the first of the others ends, and how many raised an error."""
    end = f" {min(one.diverged_s):.1f} s" if one.diverged_s else ""
    errors = f" {one.errors}!" if one.errors else ""
    return f"{one.completed}/{one.runs}{end}{errors}"


def _row(one: PointStatistics, refused: str) -> dict[str, Any]:
    """Return a point as JSON data."""
    return {**one.row(), **columns_of(COST_RATIO, one.estimate(COST_RATIO)), "refused": refused}
