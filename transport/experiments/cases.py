"""Cases of an experiment: the points of its sweep, each simulated once per seed."""

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from agent.own import controller_version
from plant.engines import engine_version
from protocol.scenario.budget import check_budget
from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.schema import Scenario
from protocol.scenario.setup import Setup
from protocol.scenario.team import resized
from protocol.wire.errors import TransportError
from protocol.wire.exit_codes import EXIT_USAGE
from transport.flight.run_files import checked
from transport.log.run_log import RunLog


class ExperimentError(TransportError, RuntimeError):
    """An experiment that cannot be started or completed: one line for the user, and exit code of the process."""

    def __init__(self, text: str, exit_code: int = EXIT_USAGE) -> None:
        super().__init__(text)
        self.exit_code = exit_code


def refused(option: str, expected: str, got: object, exit_code: int = EXIT_USAGE) -> ExperimentError:
    """Return the error for a wrong option."""
    return ExperimentError(f"{option}: expected {expected}, got {got}", exit_code)


# Keys, sections and values of a scenario that make a run random, unless they are the defaults.
_RANDOM = {"jitter_s", "loss", "duplicate", "reorder", "gust_mps", "noise", "empirical", "gilbert_elliott"}

# Sections that a team of another size replaces: settings of these would be ignored.
_TEAM_SECTIONS = ("system", "agents")


class Team(NamedTuple):
    """A team that replaces the scenario's own, made as by `transport scenario new`."""

    uavs: int  # number of UAVs
    group: int  # UAVs per agent


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a sweep: a scenario and its changes.

    A baseline is what the scenario's other points with the same group and number of UAVs are compared to.
    """

    labels: Mapping[str, str | float]  # values by column that tell the point from the scenario's others
    text: str  # the same in words, such as "200 ms"
    settings: tuple[str, ...] = ()  # changes of the scenario, as for `--set`
    baseline: bool = False
    group: str = ""  # name of points that share a baseline of their own
    team: Team | None = None  # replaces the scenario's own team
    scenario: str = ""  # file or name


# Further numbers of a run, from its setup, summary and log.
More = Callable[[Setup, Any, RunLog], Mapping[str, float | None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One run of a point."""

    point: int  # index of the point
    scenario: Scenario  # with the changes and the seed
    source: str  # file the scenario comes from
    key: str  # fingerprint of everything that determines the result
    timed: bool = False  # whether processor time and messages are measured as well
    more: More | None = None


def cases_of(
    points: Sequence[Point],
    settings: Sequence[str],
    seeds: int,
    *,
    timed: bool = False,
    more: More | None = None,
    allow_large: bool = False,
) -> list[Case]:
    """Return every run of a sweep: each point with the seeds 0, 1, ...; one seed for a deterministic point.

    The settings are applied before those of the points. Every point is repeated if processor time is measured. With
    `allow_large` runs may exceed the limits of `protocol.scenario.budget`.

    Raises: ScenarioError: a point that cannot be simulated, naming file, field, expected, got.
    """
    cases = []
    for index, point in enumerate(points):
        path = find_scenario(point.scenario)
        changes = [*settings, *point.settings]
        scenario = read_scenario(path, changes, allow_large=True)
        if point.team is not None:
            for setting in changes:
                key = setting.partition("=")[0].strip()
                if key.partition(".")[0] in _TEAM_SECTIONS and key != "system.gravity_mps2":
                    expected = "expected a key that every team has, got one of a single team"
                    raise ScenarioError(f"--set {setting}", "", expected)
            uavs, group = point.team
            source = f"{path}, {point.text}"
            scenario = resized(scenario, uavs, group=group, name=None, source=source)
        if not allow_large:
            check_budget(scenario, str(path))
        cases += cases_of_point(index, scenario, path, seeds, timed=timed, more=more)
    return cases


def cases_of_point(
    index: int, scenario: Scenario, path: Path, seeds: int, *, timed: bool = False, more: More | None = None
) -> list[Case]:
    """Return the runs of the point with an index, whose scenario comes from a file; as `cases_of`.

    Raises: ScenarioError: the scenario cannot be simulated.
    """
    if scenario.clock.mode != "lockstep":
        # In real time the result would depend on the machine and its load.
        raise ScenarioError(str(path), "clock.mode", f"expected lockstep, got {scenario.clock.mode}")
    checked(Setup.of(scenario, str(path)))  # refuses an impossible setup before the first run
    cases = []
    for seed in range(seeds if timed or is_random(scenario) else 1):
        seeded = scenario.model_copy(update={"seed": seed})
        key = key_of(seeded)
        cases.append(Case(point=index, scenario=seeded, source=str(path), key=key, timed=timed, more=more))
    return cases


def key_of(scenario: Scenario) -> str:
    """Return the fingerprint of what determines a result.

    That is the scenario without addresses, the version of the package and those of the engine and the controller.
    """
    tree = {name: part for name, part in scenario.tree().items() if name != "network"}
    content = [tree, version("payload-transport"), engine_version(scenario.plant.engine)]
    content.append(controller_version(scenario.agents.controller))
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def is_random(scenario: Scenario) -> bool:
    """Return whether runs of the scenario differ with the seed."""
    return not _RANDOM.isdisjoint(re.findall(r'"(\w+)"', scenario.model_dump_json(exclude_defaults=True)))
