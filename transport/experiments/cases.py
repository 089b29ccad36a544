"""The flights of an experiment: the points of its sweep, each flown once per seed."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.schema import Scenario
from protocol.scenario.setup import Setup
from protocol.scenario.team import resized

# Keys of a scenario that bring chance into a flight unless they are zero, and sections that do.
_CHANCE = {"jitter_s", "loss", "duplicate", "reorder", "gust_mps", "noise"}

# What a team of another size has of its own: settings of these would be lost.
_OF_A_TEAM = ("system", "agents")


@dataclass(frozen=True, slots=True)
class Team:
    """A team made in the place of the scenario's own, as `transport scenario new` makes one.

    Attributes:
        uavs: How many.
        group: UAVs per agent.
    """

    uavs: int
    group: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """Where a sweep measures: a scenario and what is changed in it.

    Attributes:
        scenario: File or name.
        labels: What tells the point from the scenario's others: values by column.
        text: The same in a sentence, such as "200 ms".
        settings: Changes on top of the scenario, as for `--set`.
        baseline: Whether it is the scenario's flight without impairment; with teams, the one that others of as many
            UAVs are compared to; with groups, those of its group.
        group: Points of a scenario that are compared to a baseline of their own, by name.
        team: Who flies instead of the scenario's own team.
    """

    scenario: str
    labels: Mapping[str, str | float]
    text: str
    settings: tuple[str, ...] = ()
    baseline: bool = False
    group: str = ""
    team: Team | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One flight.

    Attributes:
        point: Index of its point.
        scenario: As it is to be flown, seed included.
        source: File the scenario comes from.
        key: Fingerprint of all that decides the result.
        timed: Whether computation and messages are measured as well.
    """

    point: int
    scenario: Scenario
    source: str
    key: str
    timed: bool = False


def cases_of(points: Sequence[Point], settings: Sequence[str], seeds: int, *, timed: bool = False) -> list[Case]:
    """Every flight of a sweep: each point with the seeds 0, 1, ...; one seed where chance plays no part.

    Args:
        points: Of the sweep.
        settings: Changes on top of every scenario, before those of the points.
        seeds: How many.
        timed: Whether computation is measured, in which chance always plays a part.
    Raises: ScenarioError: a point that cannot be flown, naming file, field, expected, got.
    """
    cases = []
    for index, point in enumerate(points):
        path = find_scenario(point.scenario)
        scenario = _scenario(path, point, settings)
        if scenario.clock.mode != "lockstep":
            # In real time the result would be the machine's, and of how busy it is.
            raise ScenarioError(str(path), "clock.mode", f"expected lockstep, got {scenario.clock.mode}")
        samples_s = Setup.of(scenario, str(path)).samples_s  # refuses what cannot exist before anything flies
        for seed in range(seeds if timed or is_random(scenario) else 1):
            seeded = scenario.model_copy(update={"seed": seed})
            key = key_of(seeded, samples_s)
            cases.append(Case(point=index, scenario=seeded, source=str(path), key=key, timed=timed))
    return cases


def _scenario(path: Path, point: Point, settings: Sequence[str]) -> Scenario:
    """The scenario of a point, before its seed."""
    changes = [*settings, *point.settings]
    scenario = read_scenario(path, changes)
    if point.team is None:
        return scenario
    for setting in changes:
        key = setting.partition("=")[0].strip()
        if key.partition(".")[0] in _OF_A_TEAM and key != "system.gravity_mps2":
            raise ScenarioError(f"--set {setting}", "", "expected a key that every team has, got one of a single team")
    team = point.team
    return resized(scenario, path.parent, team.uavs, group=team.group, name=None, source=f"{path}, {point.text}")


def key_of(scenario: Scenario, samples_s: Mapping[str, tuple[float, ...]]) -> str:
    """Fingerprint of what decides a flight's result: the scenario but for addresses, measured delays, the version.

    Args:
        scenario: As it is flown.
        samples_s: Measured delays of its links, by file.
    """
    tree = {name: part for name, part in scenario.tree().items() if name != "network"}
    content = [tree, sorted(samples_s.items()), version("payload-transport")]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def is_random(scenario: Scenario) -> bool:
    """Whether flights of the scenario differ with the seed."""
    return _has_chance(scenario.tree())


def _has_chance(tree: Any) -> bool:
    if isinstance(tree, list):
        return any(_has_chance(entry) for entry in tree)
    if not isinstance(tree, dict):
        return False
    if tree.get("distribution") == "empirical" or "gilbert_elliott" in tree:
        return True
    return any((name in _CHANCE and _is_more_than_zero(part)) or _has_chance(part) for name, part in tree.items())


def _is_more_than_zero(part: Any) -> bool:
    """Whether any number of a value or section is."""
    if isinstance(part, dict):
        return any(_is_more_than_zero(value) for value in part.values())
    return any(part) if isinstance(part, list) else part > 0
