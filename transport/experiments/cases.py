"""Cases of an experiment: the points of its sweep, each simulated in memory once per seed."""

import hashlib
import json
import re
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from importlib.metadata import version
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import threadpoolctl

from transport.agent.user_class.user_controllers import controller_versions
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.summary_assembly import summarise
from transport.flight import memory
from transport.flight.run_files import checked
from transport.log.run_log import Recorded, RunLog
from transport.plant.engines import engine_version
from transport.protocol.scenario.scenario_file import (
    ScenarioError,
    find_scenario,
    read_scenario,
    with_settings,
)
from transport.protocol.scenario.sections.run_size import check_size
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import Team, given_values, resized
from transport.protocol.wire.codec import encode
from transport.protocol.wire.errors_and_exit_codes import EXIT_USAGE, TransportError
from transport.protocol.wire.messages import STAGES, Control, Message, Plan, StepReport, Tick

# Outcome of a case that could not be simulated.
ERROR = "error"

# Numbers of a run, each with its place in the summary.
_FROM_SUMMARY = {
    "cost_mean": ("cost", "mean"),
    "cost_max": ("cost", "max"),
    "attitude_max_deg": ("attitude_max_deg",),
    "uav_rms_m": ("uav_tracking", "rms_m"),
    "uav_max_m": ("uav_tracking", "max_m"),
    "payload_rms_m": ("payload_tracking", "rms_m"),
    "payload_max_m": ("payload_tracking", "max_m"),
    # Largest payload error at the end, `cost_and_tracking_metrics.SWING_S`.
    "swing_m": ("payload_tracking", "swing_m"),
    "separation_min_m": ("separation_min_m",),
    "plan_age_mean_ticks": ("plan_age_ticks", "mean"),
    "plan_age_max_ticks": ("plan_age_ticks", "max"),
}
# Shares of messages: count and total, each an entry of the summary's messages.
_SHARES = {"plans_lost_share": ("lost", "sent"), "plans_shared_share": ("shared", "planned")}

# Numbers of every run; None where a run has none. The first is the scenario time of the end, unless
# completed. None of them is a wall-clock time.
NUMBERS = ("lost_s", *_FROM_SUMMARY, *_SHARES)

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


# Further numbers of a run, from its setup, summary and log.
More = Callable[[Setup, Any, RunLog], Mapping[str, float | None]]


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
    exceed the limits of `protocol.scenario.sections.run_size`. Points that have been simulated before are not
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """Result of a case."""

    key: str  # of the case
    outcome: str  # as in a summary, or `ERROR` for a case that could not be simulated
    reason: str  # one line; empty when completed
    numbers: dict[str, float | None]  # by name; empty for an error


def run_in_memory(setup: Setup) -> RunLog:
    """Simulate a run in this process and return its log.

    Messages are stamped with the processor time of this thread.
    """
    messages: list[Recorded] = []
    clock_ns = time.thread_time_ns  # excludes the rest of the machine

    def record(message: Message) -> None:
        messages.append(Recorded(message=message, received_ns=clock_ns()))

    memory.simulate(setup, record, clock_ns)
    return RunLog(header={}, messages=tuple(messages), cut="")


def simulate(case: Case) -> Result:
    """Simulate a case in this process; an error is a result as well."""
    try:
        # One thread: sums have the same order on every machine.
        with threadpoolctl.threadpool_limits(1):
            return _result(case)
    except Exception as error:  # noqa: BLE001  # an error of one case must not end the others
        text = " ".join(str(error).split())
        reason = f"{type(error).__name__}: {text}"
        return Result(key=case.key, outcome=ERROR, reason=reason, numbers={})


def _result(case: Case) -> Result:
    """Simulate a case and return its outcome and numbers."""
    setup = Setup.of(case.scenario, case.source)
    if key_of(setup.scenario) != case.key:
        raise RuntimeError(
            "expected the package, engine and controller that started the experiment, got another version"
        )

    log = run_in_memory(setup)
    summary = summarise(AnalysedRun.of(setup, log))
    control = next(log.of(Control))

    is_completed = control.outcome == "completed"
    end_s = None if is_completed else control.tick * setup.settings.sampling_period_s
    if summary["collision"]:
        end_s = summary["collision"]["at_s"]
    numbers = {"lost_s": end_s, **_numbers(summary), **_radio_numbers(summary["radio"])}
    if case.more is not None:
        numbers |= case.more(setup, summary, log)
    # A kept result is read as floating-point numbers, and tables do not tell whether a run was resumed.
    numbers = {name: None if one is None else float(one) for name, one in numbers.items()}
    return Result(key=case.key, outcome=control.outcome, reason=control.reason, numbers=numbers)


def _numbers(summary: Any) -> dict[str, float | None]:
    """Return the numbers of a run from its summary."""
    numbers = {name: reduce(getitem, place, summary) for name, place in _FROM_SUMMARY.items()}
    messages = summary["messages"]
    for name, (count, total) in _SHARES.items():
        numbers[name] = messages[count] / messages[total] if messages[total] else None
    return numbers


def _radio_numbers(radio: Mapping[str, Any] | None) -> dict[str, float | None]:
    """Return airtime and delivered share of the team's radio; nothing without one."""
    if radio is None:
        return {}
    return {
        "airtime_share": radio["airtime_share"],
        "air_delivered_share": radio["delivered_share"],
        "air_delay_p99_ms": radio["delay_ms"]["p99"],
    }


def resource_use(setup: Setup, _: Any, log: RunLog) -> Mapping[str, float | None]:
    """Return messages and processor time of a run, as in docs/experiments.md.

    Nothing if it ended before its first step. A shared plan counts once for each other agent, as on
    a network without multicast. Messages to plant and coordinator are not counted: in the field
    they stay on board or do not exist.
    """
    total = STAGES.index("total")  # all stages of computation of an agent's step
    steps_ms = [float(report.times_ms[total]) for report in log.of(StepReport)]
    if not steps_ms:
        return {}

    ticks = len({report.tick for report in log.of(StepReport)})
    duration_s = ticks * setup.settings.sampling_period_s
    receivers = len(setup.agents) - 1
    plans_bytes = [len(encode(plan)) for plan in log.of(Plan) if plan.shared]

    # With plant, coordinator and messages.
    began_ns = min(log.received_ns(Tick).values())
    ended_ns = max(log.received_ns(Control).values())
    run_s = (ended_ns - began_ns) / 1e9
    return {
        "plans_per_tick": receivers * len(plans_bytes) / ticks,
        "plan_bytes_per_s": receivers * sum(plans_bytes) / duration_s,
        "cpu_step_p50_ms": float(np.median(steps_ms)),
        "cpu_step_p99_ms": float(np.percentile(steps_ms, 99.0)),
        "cpu_team_tick_ms": sum(steps_ms) / ticks,
        "cpu_flight_s_per_s": run_s / duration_s,
    }
