"""Drawn teams: `python -m benchmarks.teams` counts which of them hold silences and deaths.

Each case is flown by the drawn teams of `protocol.scenario.teams.drawn_team` with seeds 0, 1, ..: their own
geometry, periods, horizons, vehicles and late networks. The instant of the silence is drawn from the
seed, too. Beside them the team of the ready scenario `precise` is flown in each case, with ten instants.

A line for each case, `--runs` for each run; `--case TEXT` selects cases. Runs are simulated seed by seed over
all cases: those of an interrupted command are a fair sample. `--kept FOLDER` keeps them, as `--out` of
`transport experiment` does, and simulates only those not kept there.

`--margins` prints the margins of the law of UAVs alone of each team instead (`benchmarks/teams_alone.py`), with
`--first SEED` of other teams.
`--write` renews both tables in docs/record/guarantees.md, and that of the flights in README.
"""

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks import teams_alone
from benchmarks.runs import origin
from docs.tables import ROOT, completed_of, put, table
from transport.experiments.cases import Case, Point, key_of
from transport.experiments.declaration import Experiment
from transport.experiments.simulation import ERROR, Result
from transport.experiments.statistics import estimate
from transport.experiments.sweep import Results, sweep
from transport.experiments.workers import on_cores
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario, validate
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.teams.drawn_team import NOISE, drawn

TEMPLATE = "precise"
FOR_GOOD_S = 1e5
UPSET_DEG = 15.0  # attitude of the payload beyond which a run does not count as held
FROM_S = (2.0, 8.0)  # range of the instant at which the silence begins
AFTER_S = 1.0  # from the begin of the silence to the death in it
_INSTANTS = 7  # stream of the draws of these instants
_STAYS_S = 4.0  # after the silence, to the end of the run
_FOR_GOOD_FLOWN_S = 40.0  # of a silence for good, at least
_READY_SEEDS = 10  # runs of the ready team in each case
_READY_LINKS, _READY_GUST_MPS = (0.2, 0.3), 1.0  # network and gusts of its own


@dataclass(frozen=True, slots=True, kw_only=True)
class TeamCase:
    """What the drawn teams meet."""

    name: str
    silent_s: float = 0.0
    death: bool = False  # an agent dies in the silence
    # Delay, s, and loss of the links; None: the team's own.
    links: tuple[float, float] | None = None
    sensors: str = "state"
    gust_mps: float | None = 1.0  # None: the team's own
    teams: int = 60
    most_uavs: int = 8


CASES = (
    TeamCase(name="silent 4 s", silent_s=4.0),
    TeamCase(name="silent 30 s", silent_s=30.0),
    TeamCase(name="silent for good", silent_s=FOR_GOOD_S),
    TeamCase(name="a death in a silence of 4 s", silent_s=4.0, death=True),
    TeamCase(
        name="sensors of the vehicles, perfect network",
        links=(0.0, 0.0),
        sensors="vehicle",
        gust_mps=None,
        teams=30,
        most_uavs=6,
    ),
    TeamCase(
        name="sensors of the vehicles, 200 ms and 30 % loss",
        links=(0.2, 0.3),
        sensors="vehicle",
        gust_mps=None,
        teams=30,
        most_uavs=6,
    ),
    TeamCase(
        name="sensors of the vehicles, silent 10 s",
        silent_s=10.0,
        links=(0.1, 0.0),
        sensors="vehicle",
        gust_mps=None,
        teams=30,
        most_uavs=6,
    ),
)


@lru_cache(maxsize=1)
def template() -> tuple[Scenario, str]:
    """Return the ready scenario, from which teams are drawn, and its file."""
    path = find_scenario(TEMPLATE)
    return read_scenario(path), str(path)


def seeds(case: TeamCase) -> Iterator[int]:
    """Yield the seeds of the teams of a case: the first ones of at most so many UAVs."""
    found = 0
    seed = 0
    while found < case.teams:
        if len(drawn(seed, *template()).system.uav) <= case.most_uavs:
            yield seed
            found += 1
        seed += 1


def flown_scenario(case: TeamCase, seed: int, *, is_ready: bool = False) -> Scenario:
    """Return the scenario of a run of a drawn team, or of the ready one.

    Raises: ScenarioError: it is refused.
    """
    ready, path = template()
    # A ready team has a network and gusts of its own where the case has none.
    tree: dict[str, Any] = (ready if is_ready else drawn(seed, ready, path)).tree()
    links = case.links
    gust_mps = case.gust_mps
    if is_ready:
        tree["seed"] = seed
        links = links or _READY_LINKS
        gust_mps = _READY_GUST_MPS if gust_mps is None else gust_mps
    rng = np.random.default_rng([seed, _INSTANTS])
    start_s = round(float(rng.uniform(*FROM_S)), 3)
    dying = 1 + int(rng.integers(len(tree["system"]["uav"])))

    _set_sensors_and_gusts(tree, case, gust_mps)
    if links is not None:
        delay_s, loss = links
        tree["links"] |= {"delay_s": delay_s, "loss": loss, "jitter_s": 0.0}
    if case.silent_s:
        _silence(tree, start_s, start_s + case.silent_s)
    if case.death:
        tree["clock"]["on_agent_loss"] = "continue"
        fault = {"at_s": start_s + AFTER_S, "do": "kill", "target": f"agent{dying}"}
        tree["faults"]["event"] = [fault]
    return validate(tree, f"team {seed}")


def _set_sensors_and_gusts(tree: dict[str, Any], case: TeamCase, gust_mps: float | None) -> None:
    """Set sensors and estimator of a case in a scenario, and gusts, m/s; None leaves those."""
    plant = tree["plant"]
    is_sensed = case.sensors == "vehicle"
    if case.sensors != plant["sensors"]:
        plant |= {"sensors": case.sensors, "noise": NOISE if is_sensed else {}}
    tree["controller"]["estimator"] = "kalman" if is_sensed else "measured"
    if gust_mps is not None:
        plant["wind"]["gust_mps"] = [gust_mps] * 3


def _silence(tree: dict[str, Any], start_s: float, end_s: float) -> None:
    """Cut all agents off each other in a scenario from `start_s` to `end_s`, and let the run last beyond it."""
    agents = len(tree["system"]["uav"])
    tree["links"]["partition"] = [
        {"between": [f"agent{agent}"], "start_s": start_s, "end_s": end_s}
        for agent in range(1, agents)
    ]
    phases = tree["maneuver"]["phase"]
    total_s = math.fsum(phase["duration_s"] for phase in phases)
    flown_s = min(end_s + _STAYS_S, start_s + _FOR_GOOD_FLOWN_S)
    phases[-1]["duration_s"] += max(0.0, math.ceil(flown_s - total_s))


@dataclass(frozen=True, slots=True)
class Row:
    """Runs of a case that are flown by the drawn teams, or by the ready one: a point of the sweep."""

    case: TeamCase
    is_ready: bool

    @property
    def point(self) -> Point:
        """The point, whose labels and text tell the row."""
        team = TEMPLATE if self.is_ready else "drawn"
        return Point(
            {"case": self.case.name, "team": team}, f"{self.case.name}, {team}", scenario=team
        )

    def runs(self, number: int) -> Iterator[tuple[int, Case | Result]]:
        """Yield seeds and runs of the row with this number; in place of a refused run its result, an error."""
        _, path = template()
        for seed in range(_READY_SEEDS) if self.is_ready else seeds(self.case):
            try:
                scenario = flown_scenario(self.case, seed, is_ready=self.is_ready)
            except ScenarioError as error:
                yield seed, Result(key="", outcome=ERROR, reason=str(error), numbers={})
                continue
            yield seed, Case(point=number, scenario=scenario, source=path, key=key_of(scenario))


def flown(
    rows: Sequence[Row], folder: Path | None, *, jobs: int | None = None, no_fly: bool = False
) -> dict[Row, dict[int, Result]]:
    """Simulate all runs of some rows that are not kept in a folder; return the results of each row by seed.

    With `no_fly` nothing is simulated: results are those that are kept.
    """
    results_of: dict[Row, dict[int, Result]] = {row: {} for row in rows}
    cases = []
    for number, row in enumerate(rows):
        for seed, run in row.runs(number):
            if isinstance(run, Case):
                cases.append(run)
            else:
                results_of[row][seed] = run

    experiment = Experiment(name="teams", points=tuple(row.point for row in rows))
    with Results(experiment.name, folder) as kept:
        if not no_fly:
            sweep(experiment, cases, partial(on_cores, jobs=jobs), kept, Console(stderr=True))
        for case in cases:
            if case.key in kept:
                results_of[rows[case.point]][case.scenario.seed] = kept[case.key]
    return results_of


def is_held(result: Result) -> bool:
    """Return whether a run was completed within the attitude."""
    return result.outcome == "completed" and _attitude_deg(result) <= UPSET_DEG


def _attitude_deg(result: Result) -> float:
    """Return the largest attitude of a run that was simulated."""
    return result.numbers["attitude_max_deg"] or 0.0


HEADINGS = (
    "", "drawn teams: complete, 95 % interval", "within 15 deg", "refused", "attitude, deg", "largest",
    f"`{TEMPLATE}`: complete", "attitude, deg", "largest",
)  # fmt: skip
# Columns and rows of the table in README.
_SHORT = (0, 1, 4, 5, 6, 7, 8)
_SHORT_ROWS = (
    *("silent 4 s", "silent for good", "a death in a silence of 4 s"),
    "sensors of the vehicles, 200 ms and 30 % loss",
)


def cells(case: TeamCase, teams: Sequence[Result], ready: Sequence[Result]) -> list[str]:
    """Return the row of a case: the drawn teams, then the ready one.

    A team whose run could not be simulated counts as refused: its scenario excludes its parts.
    """
    held = sum(map(is_held, teams))
    refused = sum(result.outcome == ERROR for result in teams)
    completed, *attitudes = _count_and_attitudes(teams)
    counts = [completed, f"{held} of {len(teams)}", f"{refused}"]
    return [case.name, *counts, *attitudes, *_count_and_attitudes(ready)]


def _count_and_attitudes(results: Sequence[Result]) -> list[str]:
    """Return how many runs complete, and mean with 95 % interval and largest of their attitudes, deg."""
    done = [_attitude_deg(result) for result in results if result.outcome == "completed"]
    mean = estimate(done)
    if mean is None:
        return [f"0 of {len(results)}", "", ""]
    return [completed_of(len(done), len(results)), mean.text(1), f"{max(done):.1f}"]


def count(options: argparse.Namespace) -> list[list[str]]:
    """Fly the selected cases, print their lines, and return their rows."""
    chosen = [case for case in CASES if options.case in case.name]
    teams = [] if options.ready else [Row(case, is_ready=False) for case in chosen]
    rows = [*teams, *(Row(case, is_ready=True) for case in chosen)]
    results_of = flown(rows, options.kept, jobs=options.jobs, no_fly=options.no_fly)
    for row, results in results_of.items():
        for seed, result in results.items():
            if options.runs or not is_held(result):
                sys.stdout.write(f"{row.point.text}, seed {seed}: {_said(result)}\n")

    lines = []
    for case in chosen:
        of_teams, of_ready = (
            list(results_of.get(Row(case, is_ready=is_ready), {}).values())
            for is_ready in (False, True)
        )
        if of_teams or of_ready:
            lines.append(cells(case, of_teams, of_ready))
            sys.stdout.write(" | ".join(lines[-1]) + "\n")
    return lines


def _said(result: Result) -> str:
    """Return how a run ends, and its largest attitude."""
    if result.outcome == ERROR:
        return f"refused, {result.reason}"
    end_s = result.numbers["lost_s"]
    at = "" if end_s is None else f" at {end_s:.2f} s"
    return f"{result.outcome}{at}, {_attitude_deg(result):.2f} deg {result.reason}".rstrip()


def main(given: Sequence[str] | None = None) -> None:
    """Fly the cases, or compute the margins."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.teams", description=__doc__)
    parser.add_argument("--case", default="", help="text in the names of the cases to fly")
    parser.add_argument("--jobs", type=int, help="parallel runs; default: all cores")
    parser.add_argument("--runs", action="store_true", help="print a line for each run")
    parser.add_argument("--kept", type=Path, help="folder of runs")
    parser.add_argument("--ready", action="store_true", help="the ready team alone")
    parser.add_argument("--no-fly", action="store_true", help="count kept runs alone")
    parser.add_argument("--margins", action="store_true", help="margins in place of flights")
    parser.add_argument("--first", type=int, default=0, help="seed of the first of these teams")
    parser.add_argument("--write", action="store_true", help="renew the table of the page")
    options = parser.parse_args(given)
    if options.write and (options.ready or options.case):
        parser.error("--write: expected neither --ready nor --case, as the page has all of them")
    if options.write and options.first:
        parser.error("--write: expected no --first, as the page has the teams from seed 0 on")
    page = ROOT / "docs" / "record" / "guarantees.md"
    if options.margins:
        rows = teams_alone.count(template(), first=options.first, each=options.runs)
        if options.write:
            content = f"{table(teams_alone.HEADINGS, rows)}\n\n*{origin()}.*"
            put(page, "bench: teams alone", content)
        return

    rows = count(options)
    if options.write:
        put(page, "bench: teams", f"{table(HEADINGS, rows)}\n\n*{origin()}.*")
        shown = [row for row in rows if row[0] in _SHORT_ROWS]
        headings, *short = ([row[i] for i in _SHORT] for row in (HEADINGS, *shown))
        put(ROOT / "README.md", "bench: teams", table(headings, short))


if __name__ == "__main__":
    main()
