"""Searches for the worst case: against chance on planted faults, and on the ready scenarios.

`python -m benchmarks.worst --planted` counts the runs until a planted fault is found, by the search
and by random draws, over several seeds. `python -m benchmarks.worst --runs 1000` searches in the
ready scenarios within the bounds that docs/guarantees.md claims, and prints how far each is from
failing.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from transport.flight.run_files import machine
from transport.protocol.scenario.file import find_scenario, read_scenario
from transport.protocol.scenario.setup import Setup
from transport.search.candidate import Base
from transport.search.evaluation import Problem
from transport.search.objective import Objective
from transport.search.options import SearchOptions, search
from transport.search.progress import SearchProgress
from transport.search.report import in_words
from transport.search.search import Evaluations, Search, on_cores, random_search
from transport.search.space import Space, read_bounds

_CONSOLE = Console(stderr=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A scenario with changes, and the events that are drawn for it."""

    scenario: str
    settings: tuple[str, ...] = ()
    over: tuple[str, ...] = ("silence", "deaths", "gusts")

    def search(self, budget: int, seed: int) -> Search:
        """Return a search that ends with the first failure."""
        path = find_scenario(self.scenario)
        scenario = read_scenario(path, self.settings)
        base = Base(scenario=scenario, source=str(path))
        problem = Problem(base=base, objective=Objective.of("attitude", None, scenario))
        setup = Setup.of(scenario, str(path))
        bounds = read_bounds(None, setup.ticks * setup.settings.sampling_period_s)
        space = Space(self.over, bounds, scenario)
        return Search(problem=problem, space=space, budget=budget, seed=seed, until_failure=True)


# Weaknesses that were mended, switched on again by keys of the scenario.
PLANTED = {
    "a law without a fall-back in silence": Case(
        scenario="resilient", settings=("controller.silence=law",)
    ),
    "a fail-safe without height": Case(
        scenario="resilient", settings=("controller.fail_safe=level",), over=("deaths", "gusts")
    ),
    "relaxation 1": Case(
        scenario="windy", settings=("controller.relaxation=1.0",), over=("links", "gusts")
    ),
}

SENSORS = (
    "plant.sensors=vehicle",
    "controller.estimator=kalman",
    "plant.noise={position_m=0.01,velocity_mps=0.02,attitude_rad=0.0087,rate_rads=0.0175,"
    "specific_force_mps2=0.3}",
    "controller.disturbance.estimate=true",
)
READY = {
    "resilient": Case(scenario="resilient"),
    "precise, sensors of the vehicles": Case(scenario="precise", settings=SENSORS),
    "windy": Case(scenario="windy", over=("silence", "deaths")),
    "eight": Case(scenario="eight", over=("silence", "links")),
    "gap": Case(scenario="gap", over=("links", "gusts")),
    "playground": Case(scenario="playground", over=("silence", "links", "targets")),
    "paper": Case(scenario="paper", over=("gusts", "mass")),
}


def runs_until_failure(case: Case, budget: int, seed: int) -> tuple[float, float, int]:
    """Return the runs until the first failure by search and by chance, and events of the minimum."""
    chosen = case.search(budget, seed)
    with SearchProgress(chosen.problem, budget, _CONSOLE) as progress:
        result = chosen.run(Evaluations(None, {}), on_cores(None), progress)
    events = 0 if result.minimal is None else len(result.minimal.candidate.events)
    drawn = random_search(replace(chosen, until_failure=False), on_cores(None))
    chance = next((one.number for one in drawn if one.evaluation.failed), np.inf)
    return result.first_failure or np.inf, chance, events


def planted(seeds: int, budget: int) -> None:
    """Print the median runs until a planted fault is found, by search and by chance."""
    sys.stdout.write("| planted fault | search | chance | ratio | events of the minimal case |\n")
    sys.stdout.write("|---|---|---|---|---|\n")
    for name, case in PLANTED.items():
        rows = np.array([runs_until_failure(case, budget, seed) for seed in range(seeds)])
        by_search, by_chance = np.median(rows[:, :2], axis=0)
        most_events = rows[:, 2].max()
        cells = f"{by_search:g} | {by_chance:g} | {by_search / by_chance:.2f} | {most_events:g}"
        sys.stdout.write(f"| {name} | {cells} |\n")
        sys.stdout.flush()


def ready(names: Sequence[str], runs: int, folder: Path) -> None:
    """Print the least distance from failing of each ready scenario."""
    sys.stdout.write("| scenario | runs | failures | least robustness | worst or minimal case |\n")
    sys.stdout.write("|---|---|---|---|---|\n")
    for name in names or READY:
        case = READY[name]
        path = find_scenario(case.scenario)
        options = SearchOptions(over=case.over, budget=runs)
        target = folder / name.split(",")[0]
        scenario = read_scenario(path, case.settings)
        result = search(scenario, str(path), options, target, _CONSOLE)
        text = result.worst.candidate.in_words()
        if result.minimal is not None:
            text = " ".join(in_words(result.minimal))
        least = result.worst.evaluation.robustness
        cells = f"{len(result.flown)} | {result.failures} | {least:.2f} | {text}"
        sys.stdout.write(f"| {name} | {cells} |\n")
        sys.stdout.flush()


def main() -> None:
    """Run what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenarios", nargs="*", help="names of ready cases; default: all")
    parser.add_argument("--planted", action="store_true", help="planted faults against chance")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--out", type=Path, default=Path("runs/worst"))
    arguments = parser.parse_args()
    sys.stdout.write(f"{machine()}\n\n")
    if arguments.planted:
        planted(arguments.seeds, arguments.runs)
    else:
        ready(arguments.scenarios, arguments.runs, arguments.out)


if __name__ == "__main__":
    main()
