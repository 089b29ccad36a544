"""The search for the worst case from Python."""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

from transport.interface.figure import RunFigure, drawn
from transport.interface.fly import console
from transport.interface.scenario_builder import Scenario
from transport.interface.setting_arguments import ArgumentError, Settings, ShortSettings, names_of
from transport.search.search import SearchResult
from transport.search.search_options import DEFAULTS, SearchOptions, search
from transport.search.search_report import draw, in_words, scenario_text, summary, write


@dataclass(frozen=True, repr=False)
class Worst:
    """Result of `transport.worst`."""

    result: SearchResult

    @property
    def failed(self) -> bool:
        """Whether a case has failed."""
        return self.result.minimal is not None

    @property
    def summary(self) -> dict[str, Any]:
        """Numbers of the search as plain data: cases, failures, worst cases, the minimal one."""
        return summary(self.result)

    @property
    def scenario(self) -> str:
        """Minimal case that fails as a scenario file, whose comment says what happens."""
        if self.result.minimal is None:
            raise ArgumentError("scenario: expected a case that has failed, got none")
        return scenario_text(self.result.minimal)

    def plot(self) -> RunFigure:
        """Return the last seconds of the minimal case as a figure."""
        if self.result.minimal is None:
            raise ArgumentError("plot: expected a case that has failed, got none")
        minimal = self.result.minimal
        return drawn(lambda figure: draw(figure, minimal))

    def save(self, folder: "str | PathLike[str]") -> None:
        """Write summary, minimal case and figure into a folder."""
        Path(folder).mkdir(parents=True, exist_ok=True)
        write(Path(folder), self.result)

    def __repr__(self) -> str:
        return f"<Worst: {len(self.result.cases)} cases, {self.result.failures} of them fail>"

    def __str__(self) -> str:
        minimal = self.result.minimal
        if minimal is None:
            worst = self.result.worst
            value = self.result.problem.objective.in_words(worst.evaluation.value)
            cases = len(self.result.cases)
            return f"no case of {cases} fails; the worst: {value}: {worst.candidate.in_words()}"
        return "\n".join(in_words(minimal))


def worst(
    scenario: "str | PathLike[str] | Scenario" = "resilient",
    settings: Settings | None = None,
    *,
    over: str | Sequence[str] = DEFAULTS.over,
    budget: int = DEFAULTS.budget,
    objective: str = DEFAULTS.objective,
    limit: float | None = DEFAULTS.limit,
    bounds: "str | PathLike[str] | None" = None,
    search_seed: int = DEFAULTS.seed,
    workers: int | None = DEFAULTS.jobs,
    folder: "str | PathLike[str] | None" = None,
    until_failure: bool = DEFAULTS.until_failure,
    progress: bool = True,
    **short: Unpack[ShortSettings],
) -> Worst:
    """Search for the silences, deaths, weather or targets that bring a team down.

    Every case is simulated in memory. A case that fails is made minimal: fewer events, shorter
    windows, rounder numbers, a smaller team. The result does not depend on the number of workers.

    >>> import transport
    >>> hover = [{"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]}]
    >>> result = transport.worst("resilient", over=["links"], budget=8, workers=1, phases=hover)
    >>> result.failed, result.summary["cases"]
    (False, 8)

    Args:
        scenario: Scenario file, name, or `Scenario`.
        settings: Changes by dotted key.
        over: Kinds of events: silence, deaths, links, gusts, mass, sensors, targets,
            team.
        budget: Number of cases, rounded up to whole batches of 8.
        objective: attitude, separation, payload, constraint or cost.
        limit: Value at which a run has failed; by default 10 deg, 0.9 of the minimum separation,
            1 m, 0.1 and 10.
        bounds: TOML file with bounds of the events (docs/worst.md).
        search_seed: Seed of the search; `seed` is that of the runs.
        workers: Number of processes, by default one for each core.
        folder: Folder for evaluations, minimal case and figure; one of the same search is resumed.
        until_failure: End with the first batch of cases in which one has failed.
        progress: Show the progress on standard error.
        short: Changes by short name, as in `fly`.

    Raises: ScenarioError: scenario, bounds or an argument are refused, or the scenario fails
        without any event. ExperimentError: the folder cannot be used, or a worker died.
    """
    if budget < 1:
        raise ArgumentError(f"budget: expected a number >= 1, got {budget}")
    if bounds is not None and not isinstance(bounds, str | PathLike):
        raise ArgumentError(f"bounds: expected a TOML file, got {type(bounds).__name__}")
    chosen = Scenario(scenario, settings, **short)
    options = SearchOptions(
        over=names_of(over),
        budget=budget,
        objective=objective,
        limit=limit,
        bounds=None if bounds is None else Path(bounds),
        seed=search_seed,
        until_failure=until_failure,
        jobs=workers,
    )
    target = None if folder is None else Path(folder)
    shown = console(shown=progress)

    return Worst(search(chosen.validated, str(chosen.file), options, target, shown))
