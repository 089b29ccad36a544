"""Sweeps: a run for each combination of settings and seed, on this machine or on a Dask cluster."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from transport.experiments import sweep as experiment_sweep
from transport.experiments.cases import Case, Point, cases_of_point, check
from transport.experiments.declaration import Experiment
from transport.experiments.figures.axes_and_units import axis
from transport.experiments.figures.experiment_figures import fill
from transport.experiments.result_tables import TITLE, WIDTH, table_of
from transport.experiments.statistics import PointStatistics
from transport.experiments.sweep import Results
from transport.experiments.workers import check_cluster, on_cluster, on_cores
from transport.interface.figure import RunFigure, drawn
from transport.interface.fly import console
from transport.interface.scenario_builder import Scenario
from transport.interface.setting_arguments import (
    ArgumentError,
    import_pandas,
    key_of,
    plain,
    printed,
)

if TYPE_CHECKING:
    import pandas as pd

Base = str | PathLike[str] | Scenario

_NAME = "sweep"
_CURVE = "settings"  # label of all keys but the one along the axis


def sweep(
    base: "Base | Sequence[Base] | Mapping[str, Base]",
    grid: Mapping[str, Iterable[Any]],
    *,
    seeds: int = 1,
    workers: int | str | None = None,
    folder: "str | PathLike[str] | None" = None,
    progress: bool = True,
) -> "Sweep":
    """Simulate every combination of the values of some settings, and return the results as a table.

    A run that diverges is a result. Results do not depend on the number of workers.

    >>> import transport
    >>> hover = [{"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]}]
    >>> base = transport.Scenario("resilient", phases=hover)
    >>> table = transport.sweep(base, {"delay_s": [0.0, 0.1]}, workers=1)
    >>> [(row["delay_s"], row["completed"]) for row in table.rows()]
    [(0.0, 1), (0.1, 1)]

    Args:
        base: Scenario file, name, `Scenario`, several of these, or a dictionary of these by label.
        grid: Values by dotted key or short name, such as `{"links.delay_s": [0.0, 0.1, 0.2]}`.
        seeds: Number of seeds, 0, 1, ...; a run without random parts is simulated once.
        workers: Number of processes, by default one for each core; 1 simulates in this process. An
            address such as "tcp://host:8786" stands for a Dask cluster (extra `cluster`).
        folder: Folder for tables, figure and each result as it comes; a folder of the same sweep is
            resumed.
        progress: Show the progress on standard error.

    Raises: ScenarioError, ArgumentError: a combination or an argument is refused, before the first
        run. ExperimentError: a worker was lost, a run raised an error, or the folder cannot be
        used. KeyboardInterrupt: Ctrl-C; no process is left.
    """
    values = _checked_grid(grid)
    if seeds < 1:
        raise ArgumentError(f"seeds: expected a number >= 1, got {seeds}")
    simulate = simulate_with(workers)
    plan = _plan(_scenarios(base), values, seeds)

    shown = console(shown=progress)
    target = None if folder is None else Path(folder)
    with Results(_NAME, target) as results:
        experiment = Experiment(name=_NAME, points=tuple(plan.points))
        swept = experiment_sweep.sweep(experiment, plan.cases, simulate, results, shown)

    made = Sweep(swept)
    if target is not None:
        made.save(target)
    swept.check()
    return made


@dataclass(slots=True)
class _Plan:
    """Points of a sweep with their cases."""

    points: list[Point] = field(default_factory=list)
    cases: list[Case] = field(default_factory=list)


def _plan(
    scenarios: Mapping[str, Scenario], values: Mapping[str, Sequence[Any]], seeds: int
) -> _Plan:
    """Return a point for each scenario and combination of values, and a case for each seed."""
    plan = _Plan()
    for label, scenario in scenarios.items():
        for number, combination in enumerate(itertools.product(*values.values())):
            settings = dict(zip(values, combination, strict=True))
            labels = {name: _label(value) for name, value in settings.items()}
            text = ", ".join(f"{name} {value}" for name, value in labels.items())
            changed = scenario.copy(settings)
            check(changed.validated, changed.file)
            plan.cases += cases_of_point(len(plan.points), changed.validated, changed.file, seeds)
            plan.points.append(
                Point(scenario=label, labels=labels, text=text, baseline=number == 0)
            )
    return plan


def simulate_with(workers: int | str | None) -> experiment_sweep.Simulate:
    """Return the function that simulates cases on cores of this machine, or on a cluster."""
    if isinstance(workers, str):
        check_cluster(workers)
        return partial(on_cluster, address=workers)
    return partial(on_cores, jobs=workers)


class Sweep:
    """The results of a sweep: a point for each combination of settings, and its runs."""

    def __init__(self, swept: experiment_sweep.Swept) -> None:
        self._swept = swept
        # Means over completed runs with 95 % confidence intervals.
        self.points: list[PointStatistics] = swept.measured

    def __repr__(self) -> str:
        return f"Sweep({len(self.points)} points, {len(self._swept.results)} runs)"

    def __str__(self) -> str:
        """Return the table that the commands `transport experiment` print."""
        return printed(table_of(TITLE, self.points), WIDTH)

    def rows(self, table: Literal["points", "runs"] = "points") -> list[dict[str, Any]]:
        """Return a row for each point, or each run.

        Rows are those of points.csv and cases.csv (docs/experiments.md).
        """
        return self._swept.rows(table)

    def to_pandas(self, table: Literal["points", "runs"] = "points") -> "pd.DataFrame":
        """Return the rows as a table of pandas (extra `pandas`).

        Raises: ArgumentError: pandas is missing.
        """
        frame: pd.DataFrame = import_pandas().DataFrame(self.rows(table))
        return frame

    def plot(self, x: str | None = None, kind: Literal["curves", "map"] = "curves") -> RunFigure:
        """Return a figure of completed runs, mean cost and payload attitude over a setting.

        The setting x is by default the first. There is a curve for each combination of the other
        settings; or it is a map of cost over exactly two settings.

        Raises: ArgumentError: no such setting, or no map of these settings.
        """
        experiment, measured = self._drawn_as(x, kind)
        return drawn(lambda figure: fill(figure, experiment, measured))

    def save(self, folder: "str | PathLike[str]") -> list[Path]:
        """Write points.csv, cases.csv and the figure of `plot()` to a folder; return the files."""
        Path(folder).mkdir(parents=True, exist_ok=True)
        return self._swept.write(Path(folder), shown=self._drawn_as(None, "curves"))

    def _repr_html_(self) -> str:
        return f"<pre>{self}</pre>"

    def _drawn_as(self, x: str | None, kind: str) -> tuple[Experiment, list[PointStatistics]]:
        """Return the experiment with the axes of a figure, and the statistics that it shows.

        Their labels are those it is drawn by.
        """
        points = self._swept.experiment.points
        names = list(points[0].labels)
        along = names[0] if x is None else x
        if along not in names:
            raise ArgumentError(f"x: expected one of {', '.join(names)}, got {along!r}")
        if kind not in ("curves", "map"):
            raise ArgumentError(f"kind: expected 'curves' or 'map', got {kind!r}")

        others = [name for name in names if name != along]
        if kind == "map":
            values = [value for point in points for value in point.labels.values()]
            if len(others) != 1 or any(isinstance(value, str) for value in values):
                raise ArgumentError(
                    f"kind: expected two settings with numbers for a map, got {', '.join(names)}"
                )
            return Experiment(name=_NAME, points=points, x=along, y=others[0]), self.points

        measured = [
            replace(statistics, point=_relabelled(statistics.point, along, others))
            for statistics in self.points
        ]
        shown = tuple(statistics.point for statistics in measured)
        curves = _CURVE if others else None
        return Experiment(name=_NAME, points=shown, x=along, curves=curves), measured


def _relabelled(point: Point, along: str, others: Sequence[str]) -> Point:
    """Return a point with the setting along the axis; the other ones tell its curve."""
    labels = {along: point.labels[along]}
    if others:
        texts = [axis(name).text(point.labels[name]) for name in others]
        labels[_CURVE] = ", ".join(texts)
    return replace(point, labels=labels)


def _checked_grid(grid: Mapping[str, Iterable[Any]]) -> dict[str, list[Any]]:
    """Return the values of each setting as a list."""
    checked: dict[str, list[Any]] = {}
    for name, given in grid.items():
        if isinstance(given, str | Mapping) or not isinstance(given, Iterable):
            raise ArgumentError(f"{name}: expected a list of values, got {given!r:.60}")

        values: list[Any] = plain(list(given))
        if not values or len(set(map(_label, values))) < len(values):
            raise ArgumentError(
                f"{name}: expected different values, at least one, got {values!r:.60}"
            )
        checked[name] = values

    keys = [key_of(name) for name in checked]
    if not keys or "seed" in keys or len(set(keys)) < len(keys):
        raise ArgumentError(
            f"grid: expected settings other than the seed (seeds=...), each once, got {keys}"
        )
    return checked


def _label(value: Any) -> str | float:
    """Return a value as it tells a point from the others: a number, or text."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number else str(value)


def _scenarios(base: "Base | Sequence[Base] | Mapping[str, Base]") -> dict[str, Scenario]:
    """Return the scenarios of a sweep by label."""
    if isinstance(base, Mapping):
        named = [(str(label), Scenario(one)) for label, one in base.items()]
    else:
        several = [base] if isinstance(base, str | PathLike | Scenario) else base
        named = [(scenario.name, scenario) for scenario in map(Scenario, several)]

    if len(dict(named)) < max(1, len(named)):
        got = [name for name, _ in named]
        raise ArgumentError(
            f"base: expected scenarios with different names, or a dictionary with labels, got {got}"
        )
    return dict(named)
