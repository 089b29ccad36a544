"""Searches for the worst case: against chance on planted faults, and on the ready scenarios.

`python -m benchmarks.worst --planted` counts the runs until a planted fault is found, by the search
and by random draws, over several seeds. `python -m benchmarks.worst --runs 1000` searches in the
ready scenarios, within the default bounds of docs/worst.md, for how far each is from failing.
`python -m benchmarks.worst --together` simulates deaths with silences that the search has found.
With `--write` the table of `--planted` takes its place in docs/record/measured.md, the others theirs in
docs/record/guarantees.md.
"""

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.runs import origin
from docs.tables import ROOT, put, table
from transport.experiments.weather_experiment import FORCES, SENSORS
from transport.experiments.workers import Workers
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.search.candidate import Base, Candidate
from transport.search.evaluation import SearchProblem
from transport.search.kinds_of_events import Death, DrawnSilence, Event
from transport.search.objective import SearchObjective
from transport.search.search import Evaluations, Search, flying, random_search
from transport.search.search_options import SearchOptions, search
from transport.search.search_progress import SearchProgress
from transport.search.search_report import in_words
from transport.search.space import Bounds, Space

DOCUMENT = ROOT / "docs" / "record" / "measured.md"
GUARANTEES = ROOT / "docs" / "record" / "guarantees.md"
_CONSOLE = Console(stderr=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A scenario with changes, and the events that are drawn for it, within default bounds."""

    scenario: str
    settings: tuple[str, ...] = ()
    over: tuple[str, ...] = ("silence", "deaths", "gusts")


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantedFault(Case):
    """A case in which a mended weakness is switched on again, with bounds of its own."""

    bounds: Mapping[str, Any] = field(default_factory=dict)  # as a file of bounds has them

    def search(self, budget: int, seed: int) -> Search:
        """Return a search that ends with the first failure."""
        path = find_scenario(self.scenario)
        scenario = read_scenario(path, self.settings)
        base = Base(scenario=scenario, source=str(path))
        problem = SearchProblem(base=base, objective=SearchObjective.of("attitude", None, scenario))
        space = Space(self.over, Bounds.model_validate(self.bounds), scenario)
        return Search(problem=problem, space=space, budget=budget, seed=seed, until_failure=True)


# A short flight, so that many are flown: a climb to the side, and a hover.
_FLIGHT = (
    "maneuver.phase=[{name='hover',duration_s=1.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=2.0,displacement_m=[1.0,0,-1.0]},"
    "{name='hover',duration_s=4.0,displacement_m=[0,0,0]}]"
)
# Weaknesses that were mended, switched on again by keys of the scenario, and bounds within which a
# failure is a rare coincidence.
PLANTED = {
    "a law without a fall-back in silence": PlantedFault(
        scenario="resilient",
        settings=(_FLIGHT, "controller.silence=law"),
        over=("silence", "deaths"),
        bounds={
            "silence": {"start_s": [1.0, 4.0], "duration_s": [0.5, 3.0]},
            "deaths": {"at_s": [1.0, 4.0], "back_after_s": [0.5, 3.0]},
        },
    ),
    "a fail-safe without height": PlantedFault(
        scenario="resilient",
        settings=(_FLIGHT, "controller.fail_safe=level"),
        over=("deaths", "gusts"),
        bounds={"deaths": {"count": 2, "at_s": [2.0, 5.0], "back_after_s": [0.5, 3.0]}},
    ),
    "announced trajectories instead of a shared law": PlantedFault(
        scenario="paper",
        settings=(_FLIGHT,),
        over=("silence",),
        bounds={"silence": {"start_s": [1.0, 5.0], "duration_s": [0.1, 0.6]}},
    ),
}

READY = {
    "resilient": Case(scenario="resilient", over=("silence", "deaths", "links", "gusts")),
    "precise, sensors of the vehicles": Case(
        scenario="precise",
        settings=(*SENSORS, FORCES),
        over=("silence", "deaths", "links", "gusts"),
    ),
    "windy": Case(scenario="windy", over=("silence", "deaths", "links")),
    "eight": Case(scenario="eight", over=("silence", "links")),
    "gap": Case(scenario="gap", over=("links", "gusts")),
    "playground": Case(
        scenario="playground",
        settings=("maneuver.phase=[{name='hover',duration_s=15.0,displacement_m=[0,0,0]}]",),
        over=("silence", "links", "targets"),
    ),
    "paper": Case(scenario="paper", over=("gusts", "mass")),
}


# Attitude at which a team in a ready scenario counts as lost.
LOST_DEG = 20.0

# Minimal cases of searches on `resilient`, rounded.
TOGETHER: Sequence[tuple[Event, ...]] = (
    (Death(agent=1, at_s=3.0),),
    (Death(agent=4, at_s=1.0), DrawnSilence(start_s=4.0, duration_s=2.0, who="cut 2 3")),
    (Death(agent=4, at_s=1.5), DrawnSilence(start_s=2.0, duration_s=5.5)),
    (Death(agent=3, at_s=8.0), DrawnSilence(start_s=8.5, duration_s=10.0)),
    (Death(agent=2, at_s=12.0), DrawnSilence(start_s=7.5, duration_s=8.5, who="cut 2 4")),
)
_UPSET_DEG = 80.0  # limit of the attitude at which these runs end


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """Runs until a planted fault was found with one seed, infinite where it was not."""

    by_search: float
    by_chance: float
    events: int  # of the minimal case; 0 without one


def find(case: PlantedFault, budget: int, seed: int, workers: Workers) -> Found:
    """Search for a planted fault, and draw at random until it is found."""
    fly = flying(workers)
    chosen = case.search(budget, seed)
    with SearchProgress(chosen.problem, budget, _CONSOLE) as progress:
        result = chosen.run(Evaluations(None, {}), fly, progress, workers.jobs)
    minimal = result.minimal

    drawn = random_search(chosen, Evaluations(None, {}), fly)
    by_chance = next((one.number for one in drawn if one.evaluation.failed), np.inf)
    return Found(
        by_search=result.first_failure or np.inf,
        by_chance=by_chance,
        events=0 if minimal is None else len(minimal.candidate.events),
    )


def planted(names: Sequence[str], seeds: int, budget: int, workers: Workers) -> str:
    """Return the table of the runs until each planted fault is found, by search and by chance.

    A median is infinite if at least half of the seeds did not find the fault.
    """
    rows = []
    for name in names or PLANTED:
        found = [find(PLANTED[name], budget, seed, workers) for seed in range(seeds)]
        by_search = float(np.median([one.by_search for one in found]))
        by_chance = float(np.median([one.by_chance for one in found]))
        most_events = max(one.events for one in found)
        # Without a fault found by either, the ratio of the two infinite medians does not exist.
        is_found = math.isfinite(min(by_search, by_chance))
        ratio = f"{by_search / by_chance:.2f}" if is_found else "-"
        row = [name, f"{by_search:g}", f"{by_chance:g}", ratio, f"{most_events}"]
        rows.append(row)
        _CONSOLE.print(f"{' | '.join(row)}\n{found}", highlight=False)

    headings = ["planted fault", "runs, search", "runs, chance", "ratio", "events, minimal"]
    return table(headings, rows)


def ready(names: Sequence[str], runs: int, jobs: int | None, folder: Path) -> str:
    """Return the table of the least distance from failing of each ready scenario."""
    rows = []
    for name in names or READY:
        case = READY[name]
        path = find_scenario(case.scenario)
        options = SearchOptions(over=case.over, budget=runs, limit=LOST_DEG, jobs=jobs)
        target = folder / name.split(",")[0]
        scenario = read_scenario(path, case.settings)
        result = search(scenario, str(path), options, target, _CONSOLE)
        text = result.worst.candidate.in_words()
        if result.minimal is not None:
            text = " ".join(in_words(result.minimal))
        attitude = f"{result.worst.evaluation.value:.1f} deg"
        row = [
            name,
            ", ".join(case.over),
            f"{len(result.cases)}",
            f"{result.failures}",
            attitude,
            text,
        ]
        rows.append(row)
        _CONSOLE.print(" | ".join(row), highlight=False)

    headings = ["scenario", "over", "runs", "failures", "attitude", "worst or minimal case"]
    return table(headings, rows)


def together() -> str:
    """Return the table of deaths with silences, with both fail-safes."""
    path = find_scenario("resilient")
    rows = []
    for events in TOGETHER:
        candidate = Candidate(events)
        row = [candidate.in_words()]
        for fail_safe in ("follow", "level"):
            scenario = read_scenario(path, [f"controller.fail_safe={fail_safe}"])
            base = Base(scenario=scenario, source=str(path))
            objective = SearchObjective.of("attitude", _UPSET_DEG, scenario)
            found = SearchProblem(base=base, objective=objective).evaluate(candidate)
            row.append(
                f"{found.value:.1f} deg"
                if found.outcome == "completed"
                else f"**diverges** at {found.end_s:g} s"
            )
        rows.append(row)
        _CONSOLE.print(" | ".join(row), highlight=False)
    return table(["events", "`follow`", "`level`"], rows)


def main(given: Sequence[str] | None = None) -> None:
    """Run what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="names of cases; default: all")
    parser.add_argument("--planted", action="store_true", help="planted faults against chance")
    parser.add_argument("--together", action="store_true", help="deaths with silences")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--jobs", type=int, default=None, help="default: all cores")
    parser.add_argument("--out", type=Path, default=Path("runs/worst"))
    parser.add_argument("--write", action="store_true", help="put the table into its page")
    arguments = parser.parse_args(given)
    known = PLANTED if arguments.planted else READY
    for name in arguments.names:
        if arguments.together or name not in known:
            names = "no names" if arguments.together else f"one of {', '.join(known)}"
            parser.error(f"names: expected {names}, got {name!r}")
    if arguments.write and arguments.names:
        parser.error("--write: expected no names, as it renews a whole table")

    if arguments.planted:
        with Workers(arguments.jobs) as workers:
            content = planted(arguments.names, arguments.seeds, arguments.runs, workers)
    elif arguments.together:
        content = together()
    else:
        content = ready(arguments.names, arguments.runs, arguments.jobs, arguments.out)

    content = f"{content}\n\n*{origin()}*"
    sys.stdout.write(f"{content}\n")
    if arguments.write and arguments.planted:
        put(DOCUMENT, "planted", content)
    elif arguments.write:
        put(GUARANTEES, "together" if arguments.together else "ready", content)


if __name__ == "__main__":
    main()
