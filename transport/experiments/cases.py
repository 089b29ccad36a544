"""The flights of an experiment: the points of its sweep, each flown once per seed."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from protocol.scenario import Scenario
from protocol.scenario_file import ScenarioError, find_scenario, read_scenario
from protocol.setup import Setup

# Keys of a scenario that bring chance into a flight unless they are zero, and sections that do.
_CHANCE = {"jitter_s", "loss", "duplicate", "reorder", "gust_mps", "noise"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """Where a sweep measures: a scenario and what is changed in it.

    Attributes:
        scenario: File or name.
        labels: What tells the point from the scenario's others: values by column.
        text: The same in a sentence, such as "200 ms".
        settings: Changes on top of the scenario, as for `--set`.
        baseline: Whether it is the scenario's flight without impairment.
    """

    scenario: str
    labels: Mapping[str, str | float]
    text: str
    settings: tuple[str, ...] = ()
    baseline: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One flight.

    Attributes:
        point: Index of its point.
        scenario: As it is to be flown, seed included.
        source: File the scenario comes from.
        key: Fingerprint of all that decides the result.
    """

    point: int
    scenario: Scenario
    source: str
    key: str


def cases_of(points: Sequence[Point], settings: Sequence[str], seeds: int) -> list[Case]:
    """Every flight of a sweep: each point with the seeds 0, 1, ...; one seed where chance plays no part.

    Args:
        points: Of the sweep.
        settings: Changes on top of every scenario, before those of the points.
        seeds: How many.
    Raises: ScenarioError: a point that cannot be flown, naming file, field, expected, got.
    """
    cases = []
    for index, point in enumerate(points):
        path = find_scenario(point.scenario)
        scenario = read_scenario(path, [*settings, *point.settings])
        if scenario.clock.mode != "lockstep":
            # In real time the result would be the machine's, and of how busy it is.
            raise ScenarioError(str(path), "clock.mode", f"expected lockstep, got {scenario.clock.mode}")
        samples_s = Setup.of(scenario, str(path)).samples_s  # refuses what cannot exist before anything flies
        for seed in range(seeds if is_random(scenario) else 1):
            seeded = scenario.model_copy(update={"seed": seed})
            cases.append(Case(point=index, scenario=seeded, source=str(path), key=key_of(seeded, samples_s)))
    return cases


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
