"""The arena of algorithms from Python."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Literal

from transport.experiments.arena import arena_runs as experiment_arena
from transport.experiments.arena.arena_measures import MEASURES
from transport.experiments.arena.arena_report import ArenaResult, conduct
from transport.experiments.figures.experiment_figures import fill
from transport.experiments.figures.figure_arena import draw_measure
from transport.interface.figure import RunFigure, drawn
from transport.interface.fly import console
from transport.interface.setting_arguments import ArgumentError, names_of, plain, printed
from transport.interface.swept_runs import simulate_with

_WIDTH = 150  # characters


class Arena:
    """Result of `transport.arena`: every algorithm on every task and network."""

    def __init__(self, result: ArenaResult) -> None:
        self._result = result

    def __str__(self) -> str:
        """Return a table for each measure, as `transport arena` prints them."""
        return "\n\n".join(printed(table, _WIDTH) for table in self._result.tables())

    @property
    def notes(self) -> list[str]:
        """What was tuned for each algorithm, and what could not be flown and why."""
        return self._result.sentences()

    @property
    def content(self) -> dict[str, Any]:
        """Results and versions as plain data, as in arena.json."""
        return self._result.content()

    def rows(self, table: Literal["points", "runs"] = "points") -> list[dict[str, Any]]:
        """Return a row for each task, network and algorithm, or for each run (docs/arena.md)."""
        return self._result.swept.rows(table)

    def plot(self, measure: str = "") -> RunFigure:
        """Return the matrix of the completed runs, or of a measure: cost, error, distance, step, ...

        Raises: ArgumentError: no such measure.
        """
        swept = self._result.swept
        if measure:
            if measure not in MEASURES:
                raise ArgumentError(
                    f"measure: expected one of {', '.join(MEASURES)}, got {measure!r}"
                )
            axis = MEASURES[measure]
            arguments = (swept.measured, axis.number, axis.drawn, axis.factor)
            return drawn(lambda figure: draw_measure(figure, *arguments))
        return drawn(lambda figure: fill(figure, swept.experiment, swept.measured))

    def save(self, folder: "str | PathLike[str]") -> list[Path]:
        """Write arena.json, tables and figure to a folder; return the files."""
        Path(folder).mkdir(parents=True, exist_ok=True)
        return self._result.write(Path(folder))

    def _repr_html_(self) -> str:
        return f"<pre>{self}</pre>"


def arena(
    controllers: "str | type | Sequence[str | type]" = (),
    *,
    tasks: str | Sequence[str] = (),
    networks: str | Sequence[str] = (),
    algorithms: str | Sequence[str] = (),
    seeds: int = experiment_arena.SEEDS,
    workers: int | str | None = None,
    folder: "str | PathLike[str] | None" = None,
    progress: bool = True,
) -> Arena:
    """Fly algorithms on the tasks and networks of the arena and measure them (docs/arena.md).

    >>> import transport
    >>> result = transport.arena(tasks=["gusts"], networks=["perfect"], algorithms=["alone"],
    ...     seeds=1, workers=1, progress=False)
    >>> [(row["algorithm"], row["completed"]) for row in result.rows()]
    [('centralized', 1), ('alone', 1)]

    Args:
        controllers: Classes that enter, or their names "module:Class".
        tasks: Names of tasks, by default all.
        networks: Names of networks, by default all; the perfect one is always among them.
        algorithms: Names of the project's algorithms that fly too, by default all; `centralized`,
            the reference of the costs, is always among them.
        seeds: Number of seeds, 0, 1, ...; a run without random parts is simulated once.
        workers: As of `sweep`.
        folder: Folder for results, tables and figure; one of an arena is resumed.
        progress: Show the progress on standard error.

    Raises: ExperimentError: a name is unknown, a class cannot enter, a worker was lost, or a run
        raised an error. KeyboardInterrupt: Ctrl-C; no process is left.
    """
    if seeds < 1:
        raise ArgumentError(f"seeds: expected a number >= 1, got {seeds}")
    given = [controllers] if isinstance(controllers, str | type) else list(controllers)
    simulate = simulate_with(workers)
    made = experiment_arena.arena(
        plain(given),
        tasks=names_of(tasks),
        networks=names_of(networks),
        algorithms=names_of(algorithms),
        seeds=seeds,
    )

    target = None if folder is None else Path(folder)
    result = conduct(made, simulate, target, console(shown=progress))
    if target is not None:
        result.write(target)
    result.swept.check()
    return Arena(result)
