"""Cases of an experiment: each point of its sweep with each seed, and the fingerprint of what determines a result."""

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from transport.agent.user_class.user_controllers import controller_versions
from transport.experiments.run_numbers import More, resource_use
from transport.flight.run_files import checked
from transport.plant.engines import engine_version
from transport.protocol.scenario.scenario_file import (
    ScenarioError,
    find_scenario,
    read_scenario,
    with_settings,
)
from transport.protocol.scenario.sections.limits_on_size import check_size
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import Team, given_values, resized
from transport.protocol.wire.errors_and_exit_codes import EXIT_USAGE, TransportError

# Keys, sections and values of a scenario that make draws from the seed, unless they are defaults.
_RANDOM = {
    "jitter_s",
    "loss",
    "duplicate",
    "reorder",
    "gust_mps",
    "noise",
    "empirical",
    "gilbert_elliott",
    "radio",
}


class ExperimentError(TransportError, RuntimeError):
    """An experiment that cannot be started or completed.

    The text is one line for the user; the process ends with the exit code.
    """

    def __init__(self, text: str, exit_code: int = EXIT_USAGE) -> None:
        super().__init__(text)
        self.exit_code = exit_code


def refused(
    option: str, expected: str, got: object, exit_code: int = EXIT_USAGE
) -> ExperimentError:
    """Return the error for a wrong option."""
    return ExperimentError(f"{option}: expected {expected}, got {got}", exit_code)


def check_names(option: str, given: Iterable[str], possible: Collection[str]) -> None:
    """Refuse a value of an option that is none of the possible ones. Raises: ExperimentError."""
    for value in given:
        if value not in possible:
            separator = "; " if any("," in name for name in possible) else ", "
            raise refused(option, f"one of {separator.join(possible)}", value)


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a sweep: a scenario and its changes.

    A baseline is what the scenario's other points with the same group are compared to.
    """

    labels: Mapping[str, str | float]  # values by column that tell it from the scenario's others
    text: str  # the same in words, such as "200 ms"
    settings: tuple[str, ...] = ()  # changes of the scenario, as for `--set`
    baseline: bool = False
    group: str = ""  # name of points that share a baseline of their own
    # Number of UAVs and UAVs per agent, as of `transport scenario new`.
    team: tuple[int, int] | None = None
    scenario: str = ""  # file or name
    # Further settings of each seed, such as a random instant: as many runs as there are settings here.
    by_seed: tuple[tuple[str, ...], ...] = ()

    def read(self, settings: Sequence[str] = (), seed: int = 0) -> Scenario:
        """Return the scenario with settings, then those of the point and of a seed, of any size.

        Raises: ScenarioError: naming file or setting, field, expected, got.
        """
        path = find_scenario(self.scenario)
        drawn = self.by_seed[seed] if self.by_seed else ()
        changes = [*settings, *self.settings, *drawn]
        if self.team is None:
            return read_scenario(path, changes, allow_large=True)

        uavs, group = self.team
        team = resized(read_scenario(path), Team(uavs=uavs, group=group), str(path))
        return with_settings(given_values(team), changes, str(path), allow_large=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One run of a point."""

    point: int  # index of the point
    scenario: Scenario  # with the changes and the seed
    source: str  # file the scenario comes from
    key: str  # fingerprint of everything that determines the result
    more: More | None = None


def cases_of(
    points: Sequence[Point],
    settings: Sequence[str],
    seeds: int,
    *,
    more: More | None = None,
    allow_large: bool = False,
    simulated_before: bool = False,
) -> list[Case]:
    """Return every run of a sweep: each point with the seeds 0, 1, ...

    A deterministic point has one seed. The settings are applied before those of the points. Runs have
    further numbers by `more`; with `resource_use` all are repeated. With `allow_large` runs may
    exceed the limits of `protocol.scenario.sections.limits_on_size`. Points that have been simulated before are not
    set up, which takes a second for a large team.

    Raises: ScenarioError: a point that cannot be simulated, naming file, field, expected, got.
    """
    cases = []
    for index, point in enumerate(points):
        path = find_scenario(point.scenario)
        scenario = point.read(settings)
        if not allow_large:
            check_size(scenario, str(path))
        if not simulated_before:
            check(scenario, path)
        drawn = [point.read(settings, seed) for seed in range(len(point.by_seed))]
        cases += cases_of_point(index, scenario, path, seeds, drawn, more=more)
    return cases


def check(scenario: Scenario, path: Path) -> None:
    """Refuse an impossible setup before the first run.

    Raises: ScenarioError: the scenario cannot be simulated.
    """
    checked(Setup.of(scenario, str(path)))


def cases_of_point(
    index: int,
    scenario: Scenario,
    path: Path,
    seeds: int,
    drawn: Sequence[Scenario] = (),
    *,
    more: More | None = None,
) -> list[Case]:
    """Return the runs of the point with an index, whose scenario comes from a file; as `cases_of`.

    With a scenario for each seed, `drawn`, these are run.

    Raises: ScenarioError: the scenario is in real time.
    """
    if scenario.clock.mode != "lockstep":
        # In real time the result would depend on the machine and its load.
        problem = f"expected lockstep, got {scenario.clock.mode}"
        raise ScenarioError(str(path), "clock.mode", problem)

    is_repeated = more is resource_use or is_random(scenario)
    scenarios = drawn or [scenario] * (seeds if is_repeated else 1)
    cases = []
    for seed, unseeded in enumerate(scenarios):
        seeded = unseeded.model_copy(update={"seed": seed})
        key = key_of(seeded)
        cases.append(Case(point=index, scenario=seeded, source=str(path), key=key, more=more))
    return cases


def key_of(scenario: Scenario) -> str:
    """Return the fingerprint of what determines a result.

    That is the scenario without addresses, and the versions of package, engine and controller.
    """
    tree = {name: part for name, part in scenario.tree().items() if name != "network"}
    content = [
        tree,
        version("payload-transport"),
        engine_version(scenario.plant.engine),
        controller_versions(scenario),
    ]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def is_random(scenario: Scenario) -> bool:
    """Return whether runs of the scenario differ with the seed.

    They do if a key of `_RANDOM`, at any depth, is not at its default.
    """
    changed = scenario.model_dump_json(exclude_defaults=True)
    keys_and_texts = set(re.findall(r'"(\w+)"', changed))
    return bool(keys_and_texts & _RANDOM)
