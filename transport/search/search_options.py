"""Options of a search, as the command and the Python interface have them, and a search with its folder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from transport.experiments.workers import Workers
from transport.flight.progress import compile_models
from transport.flight.run_files import checked
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.search.candidate import Base
from transport.search.evaluation import SearchProblem
from transport.search.objective import SearchObjective
from transport.search.search import Evaluations, Search, SearchResult, flying
from transport.search.search_progress import SearchProgress
from transport.search.search_report import write
from transport.search.space import Bounds, Space, read_bounds


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchOptions:
    """What is drawn, what counts as a failure, and how long is searched."""

    over: tuple[str, ...] = ("silence", "deaths", "links")  # of `space.KINDS`
    budget: int = 300  # cases to evaluate, in whole batches
    objective: str = "attitude"  # of `objective.MEASURES`
    limit: float | None = None  # None: that of the objective
    bounds: Path | None = None  # file of bounds of the events; None: those of `space.Bounds`
    seed: int = 0  # of the search
    until_failure: bool = False  # end with the first batch that has a failure
    jobs: int | None = None  # worker processes; None: one for each core


# The defaults of the command and of Python are these.
DEFAULTS = SearchOptions()


def search(
    scenario: Scenario, source: str, options: SearchOptions, folder: Path | None, console: Console
) -> SearchResult:
    """Search for the worst case of a scenario; with a folder, resume what is there and write the results.

    Raises: ScenarioError: scenario, bounds or options are refused, or the scenario fails without
        any event. ExperimentError: the folder cannot be used, or a worker died.
    """
    base = Base(scenario=scenario, source=source)
    objective = SearchObjective.of(options.objective, options.limit, scenario)
    problem = SearchProblem(base=base, objective=objective)
    setup = Setup.of(scenario, source)
    checked(setup)
    duration_s = setup.ticks * setup.settings.sampling_period_s
    bounds = read_bounds(options.bounds, duration_s, options.over)
    chosen = Search(
        problem=problem,
        space=Space(options.over, bounds, scenario),
        budget=options.budget,
        seed=options.seed,
        until_failure=options.until_failure,
    )
    compile_models([setup.scenario], console)
    evaluations = Evaluations(folder, _identity(problem, bounds, options))

    try:
        with (
            Workers(options.jobs) as workers,
            SearchProgress(problem, options.budget, console) as progress,
        ):
            result = chosen.run(evaluations, flying(workers), progress, workers.jobs)
    finally:
        evaluations.close()

    if folder is not None:
        write(folder, result)
    return result


def _identity(problem: SearchProblem, bounds: Bounds, options: SearchOptions) -> dict[str, Any]:
    """Return what two searches share of which one resumes the other; the budget may grow."""
    return {
        "scenario": problem.base.scenario.digest(),
        "objective": [options.objective, problem.objective.limit],
        "over": list(options.over),
        "bounds": bounds.model_dump(mode="json"),
        "seed": options.seed,
    }
