"""The arena: every algorithm on every task and network, measured along separate axes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from transport.analysis.cost_and_tracking_metrics import SWING_S
from transport.experiments.arena.arena_algorithms import REFERENCE, Algorithm, algorithms_of
from transport.experiments.arena.arena_tasks_and_networks import NETWORKS, PERFECT, SCENARIO, TASKS
from transport.experiments.cases import Case, Point, cases_of_point, check, refused
from transport.experiments.declaration import Experiment
from transport.experiments.run_numbers import resource_use
from transport.log.run_log import RunLog
from transport.model.state import R0
from transport.protocol.scenario.scenario_file import find_scenario
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import PlantState, Target

NAME = "arena"
SEEDS = 3
# Defaults of the common options; the command has a report of its own.
DECLARED = Experiment(name=NAME, seeds=SEEDS, drawn_as="arena", scenarios=())

# Number of a run: largest violation of the constraint of a task, in its unit.
VIOLATION = "own_violation_max"
FAILED = "failed_steps_share"
# Distance of the payload from its goal at the end, of tasks in which only one agent knows the goal or the way, m.
FROM_GOAL = "from_goal_m"


@dataclass(frozen=True, slots=True, kw_only=True)
class ArenaRuns:
    """Cases of the arena, and the combinations that cannot be flown."""

    algorithms: Mapping[str, Algorithm]
    experiment: Experiment
    cases: Sequence[Case]
    refused: Mapping[int, str]  # why a point cannot be flown, by its index
    seeds: int


def arena(
    controllers: Sequence[str] = (),
    *,
    tasks: Sequence[str] = (),
    networks: Sequence[str] = (),
    algorithms: Sequence[str] = (),
    seeds: int = SEEDS,
) -> ArenaRuns:
    """Return the arena of some tasks, networks and algorithms, by default of all.

    The reference of the costs is always among them.

    Args:
        controllers: Classes that enter, "package.module:Class".
        tasks: Names; without any all.
        networks: The same.
        algorithms: The same, of algorithms of the project and `controllers`.
        seeds: Repetitions of a random run.

    Raises: ExperimentError: a name is unknown, or a class cannot enter.
    """
    known = algorithms_of(controllers)
    chosen = _chosen("--algorithm", algorithms, known)
    if algorithms:
        chosen = dict.fromkeys([REFERENCE, *chosen, *controllers])
    rows = [
        (task, network, known[name])
        for task in _chosen("--task", tasks, TASKS)
        for network in _chosen("--network", [PERFECT, *networks] if networks else (), NETWORKS)
        for name in chosen
        if network == PERFECT or not known[name].centralized
    ]
    points = tuple(_point(*row) for row in rows)

    cases: list[Case] = []
    impossible: dict[int, str] = {}
    for index, point in enumerate(points):
        try:
            cases += _cases(index, point, seeds)
        except ScenarioError as error:
            impossible[index] = error.problem
    if not cases:
        raise refused("arena", "a combination that can be flown", next(iter(impossible.values())))
    experiment = Experiment(name=NAME, points=points, drawn_as="arena", seeds=seeds)
    return ArenaRuns(
        algorithms={name: known[name] for name in chosen},
        experiment=experiment,
        cases=cases,
        refused=impossible,
        seeds=seeds,
    )


def _chosen(option: str, names: Sequence[str], known: Mapping[str, Any]) -> dict[str, None]:
    """Return the names in their order, without any all known ones.

    Raises: ExperimentError: an unknown one.
    """
    unknown = [name for name in names if name not in known]
    if unknown:
        raise refused(option, f"one of {', '.join(known)}", repr(unknown[0]))
    return dict.fromkeys(name for name in known if name in names or not names)


def _point(task: str, network: str, algorithm: Algorithm) -> Point:
    """Return a task on a network by an algorithm as a point of the sweep.

    A centralized one is spared deaths and silence: it is what a team could do at best.
    """
    chosen = TASKS[task]
    failures = () if algorithm.centralized else chosen.failures
    own = algorithm.settings_for(chosen.uavs)
    return Point(
        {"task": task, "network": network, "algorithm": algorithm.name},
        f"{task}, {network}, {algorithm.name}",
        # Those of the task last: an algorithm changes nothing that a task sets.
        (*own, *NETWORKS[network], *chosen.settings, *failures),
        baseline=algorithm.name == REFERENCE,
        group=task,
        team=None if chosen.uavs == 4 else (chosen.uavs, 1),
        scenario=SCENARIO,
    )


def _cases(index: int, point: Point, seeds: int) -> list[Case]:
    """Return the runs of a point. Raises: ScenarioError: it cannot be flown."""
    scenario = point.read()
    path = find_scenario(SCENARIO)
    check(scenario, path)
    return cases_of_point(index, scenario, path, seeds, more=axes)


def axes(setup: Setup, summary: Any, log: RunLog) -> Mapping[str, float | None]:
    """Return the numbers of a run that are not in every experiment."""
    numbers = dict(resource_use(setup, summary, log))
    violations = [one["violation_max"] for one in summary["own_constraints"]]
    if violations:
        known = [violation for violation in violations if violation is not None]
        numbers[VIOLATION] = max(known, default=None)
    steps = len(setup.agents) * setup.ticks
    numbers[FAILED] = summary["solver"]["failures"] / steps
    if _is_of_information(setup, log):
        numbers[FROM_GOAL] = _from_goal_m(setup, log)
    return numbers


def _is_of_information(setup: Setup, log: RunLog) -> bool:
    """Return whether one agent alone is told a target, or obstacles are known by sight only."""
    is_told = any(target.to for target in log.of(Target))
    return is_told or any(one.seen_within_m for one in setup.scenario.obstacle)


def _from_goal_m(setup: Setup, log: RunLog) -> float | None:
    """Return the distance of the payload's mean place from the goal over the last swing of a run, m."""
    maneuver = setup.after(log.of(Target)).maneuver
    goal_I = maneuver.path(np.array([maneuver.duration_s]))[0][0]
    payload_I = [one.x[R0] for one in log.of(PlantState)]
    last = round(SWING_S / setup.settings.sampling_period_s)
    return float(np.linalg.norm(np.mean(payload_I[-last:], axis=0) - goal_I))
