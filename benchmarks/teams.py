"""Drawn teams: `python -m benchmarks.teams` counts which of them hold silences and deaths.

Each case is flown by the drawn teams of `protocol.scenario.teams.drawn_team` with seeds 0, 1, ..: their own
geometry, periods, horizons, vehicles and late networks. The instant of the silence is drawn from the
seed, too. A line for each case, `--runs` for each run; `--case TEXT` selects cases. `--kept FOLDER`
keeps runs, and flies only those not kept there, in a drawn order of all cases and teams: those kept by an
interrupted command are a fair sample. Two commands share a folder if one goes `--backwards`.
Beside them the team of the ready scenario `precise` is flown in each case, with ten instants.

`--margins` prints the slowest decay and the margins of the law of UAVs alone of each team instead, with
`--first SEED` of other teams.
`--write` renews both tables in docs/record/guarantees.md, and that of the flights in README.
"""

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import threadpoolctl

from benchmarks.runs import origin
from docs.tables import ROOT, completed_of, put, table
from transport.experiments.statistics import estimate
from transport.flight.memory import simulate
from transport.model.state import StateView
from transport.mpc.margins.actual_plant import Mismatch
from transport.mpc.margins.design_of_gains_alone import DECAY_PER_S, FAMILY
from transport.mpc.margins.sampled_loop import margins
from transport.protocol.scenario.files.atomic_writing import write_whole
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario, validate
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.drawn_team import NOISE, drawn
from transport.protocol.wire.messages import Message, PlantState

TEMPLATE = "precise"
FOR_GOOD_S = 1e5
UPSET_DEG = 15.0  # attitude of the payload beyond which a run does not count as held
_FROM_S = (2.0, 8.0)  # range of the instant at which the silence begins
_AFTER_S = 1.0  # from the begin of the silence to the death in it
_STAYS_S = 4.0  # after the silence, to the end of the run
_FOR_GOOD_FLOWN_S = 40.0  # of a silence for good, at least
_READY_SEEDS = 10  # runs of the ready team in each case
_READY_LINKS, _READY_GUST_MPS = (0.2, 0.3), 1.0  # network and gusts of its own
_ORDER = 0  # seed of the order in which runs are flown
_DELAY_MS, _LAG_MS = 20.0, 25.0  # wanted margins


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
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
    Case(name="silent 4 s", silent_s=4.0),
    Case(name="silent 30 s", silent_s=30.0),
    Case(name="silent for good", silent_s=FOR_GOOD_S),
    Case(name="a death in a silence of 4 s", silent_s=4.0, death=True),
    Case(
        name="sensors of the vehicles, perfect network",
        links=(0.0, 0.0),
        sensors="vehicle",
        gust_mps=None,
        teams=30,
        most_uavs=6,
    ),
    Case(
        name="sensors of the vehicles, 200 ms and 30 % loss",
        links=(0.2, 0.3),
        sensors="vehicle",
        gust_mps=None,
        teams=30,
        most_uavs=6,
    ),
    Case(
        name="sensors of the vehicles, silent 10 s",
        silent_s=10.0,
        links=(0.1, 0.0),
        sensors="vehicle",
        gust_mps=None,
        teams=30,
        most_uavs=6,
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """Result of a run."""

    team: int  # its seed
    outcome: str  # as in a summary, or "refused"
    attitude_deg: float
    at_s: float  # of the largest attitude
    end_s: float
    text: str  # the team in words, or the reason of the refusal

    @property
    def is_held(self) -> bool:
        """Whether the run was completed within the attitude."""
        return self.outcome == "completed" and self.attitude_deg <= UPSET_DEG


@lru_cache(maxsize=1)
def _template() -> tuple[Scenario, str]:
    path = find_scenario(TEMPLATE)
    return read_scenario(path), str(path)


def seeds(case: Case) -> Iterator[int]:
    """Yield the seeds of the teams of a case: the first ones of at most so many UAVs."""
    found = 0
    seed = 0
    while found < case.teams:
        if len(drawn(seed, *_template()).system.uav) <= case.most_uavs:
            yield seed
            found += 1
        seed += 1


def flown_scenario(case: Case, seed: int, *, is_ready: bool = False) -> Scenario:
    """Return the scenario of a run of a drawn team, or of the ready one.

    Raises: ScenarioError: it is refused.
    """
    template, path = _template()
    # A ready team has a network and gusts of its own where the case has none.
    tree: dict[str, Any] = (template if is_ready else drawn(seed, template, path)).tree()
    links, gust_mps = case.links, case.gust_mps
    if is_ready:
        tree["seed"] = seed
        links = links or _READY_LINKS
        gust_mps = _READY_GUST_MPS if gust_mps is None else gust_mps
    rng = np.random.default_rng([seed, 7])
    start_s = round(float(rng.uniform(*_FROM_S)), 3)
    dying = 1 + int(rng.integers(len(tree["system"]["uav"])))

    _set_sensors_and_gusts(tree, case, gust_mps)
    if links is not None:
        delay_s, loss = links
        tree["links"] |= {"delay_s": delay_s, "loss": loss, "jitter_s": 0.0}
    if case.silent_s:
        _silence(tree, start_s, start_s + case.silent_s)
    if case.death:
        tree["clock"]["on_agent_loss"] = "continue"
        fault = {"at_s": start_s + _AFTER_S, "do": "kill", "target": f"agent{dying}"}
        tree["faults"]["event"] = [fault]
    return validate(tree, f"team {seed}")


def _set_sensors_and_gusts(tree: dict[str, Any], case: Case, gust_mps: float | None) -> None:
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


def fly(case: Case, seed: int, *, is_ready: bool = False) -> Flown:
    """Fly a case with the team of a seed, or with the ready team and the instant of the seed."""
    try:
        setup = Setup.of(flown_scenario(case, seed, is_ready=is_ready), f"team {seed}")
    except ScenarioError as error:
        return Flown(
            team=seed, outcome="refused", attitude_deg=0.0, at_s=0.0, end_s=0.0, text=str(error)
        )
    period_s = setup.settings.sampling_period_s
    attitude_deg, at_tick, end_tick = 0.0, 0, 0

    def watch(message: Message) -> None:
        nonlocal attitude_deg, at_tick, end_tick
        if isinstance(message, PlantState):
            end_tick = message.tick
            now_deg = float(np.degrees(np.abs(StateView(message.x).Theta0).max()))
            if now_deg > attitude_deg:
                attitude_deg, at_tick = now_deg, end_tick

    with threadpoolctl.threadpool_limits(1):
        control = simulate(setup, watch)
    gains = "" if setup.alone is None else setup.alone.in_words()
    actuation = "next tick" if setup.scenario.clock.next_tick else "immediate"
    text = f"N {setup.system.N}, T_s {period_s:g} s, {setup.settings.inputs}, {actuation}, {gains}"
    return Flown(
        team=seed,
        outcome=control.outcome,
        attitude_deg=round(attitude_deg, 2),
        at_s=round(at_tick * period_s, 2),
        end_s=round(end_tick * period_s, 2),
        text=text,
    )


# Runs by case, whether the team is the ready one, and seed.
_Runs = dict[tuple[str, bool, int], Flown]


def _runs(options: argparse.Namespace) -> _Runs:
    """Return the runs of the selected cases, kept or flown."""
    wanted = [(case, False, seed) for case in CASES for seed in seeds(case)]
    wanted += [(case, True, seed) for case in CASES for seed in range(_READY_SEEDS)]
    in_order = [wanted[i] for i in np.random.default_rng(_ORDER).permutation(len(wanted))]
    if options.backwards:
        in_order.reverse()

    runs: _Runs = {}
    for case, is_ready, seed in in_order:
        if options.case not in case.name or (options.ready and not is_ready):
            continue
        file = _file_name(case, seed, is_ready=is_ready)
        path = None if options.kept is None else options.kept / file
        if path is not None and path.exists():
            run = Flown(**json.loads(path.read_bytes()))
        elif options.no_fly:
            continue
        else:
            run = fly(case, seed, is_ready=is_ready)
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                write_whole(path, json.dumps(asdict(run)).encode())
        if options.runs or not run.is_held:
            sys.stdout.write(f"{case.name}{', ready' * is_ready}: {run}\n")
            sys.stdout.flush()
        runs[case.name, is_ready, seed] = run
    return runs


def _file_name(case: Case, seed: int, *, is_ready: bool) -> str:
    """Return the file of a kept run."""
    words = case.name.replace("%", "percent").replace(",", "").replace(" ", "-")
    return f"{words}-{'ready-' * is_ready}{seed}.json"


HEADINGS = (
    "", "drawn teams: complete, 95 % interval", "within 15 deg", "refused", "attitude, deg", "largest",
    f"`{TEMPLATE}`: complete", "attitude, deg", "largest",
)  # fmt: skip
_SHORT = (0, 1, 4, 5, 6, 7, 8)  # columns of the table in README


def cells(case: Case, runs: Sequence[Flown], ready: Sequence[Flown]) -> list[str]:
    """Return the row of a case: the drawn teams, then the ready one."""
    held = sum(run.is_held for run in runs)
    refused = sum(run.outcome == "refused" for run in runs)
    drawn_count, *drawn_deg = _count_and_attitudes(runs)
    counts = [drawn_count, f"{held} of {len(runs)}", f"{refused}"]
    return [case.name, *counts, *drawn_deg, *_count_and_attitudes(ready)]


def _count_and_attitudes(runs: Sequence[Flown]) -> list[str]:
    """Return how many runs complete, and mean with 95 % interval and largest of their attitudes, deg."""
    done = [run.attitude_deg for run in runs if run.outcome == "completed"]
    mean = estimate(done)
    if mean is None:
        return [f"0 of {len(runs)}", "", ""]
    return [completed_of(len(done), len(runs)), mean.text(1), f"{max(done):.1f}"]


def count(options: argparse.Namespace) -> list[list[str]]:
    """Fly the cases, print their lines, and return their rows."""
    flown = _runs(options)
    rows = []
    for case in CASES:
        drawn_runs, ready_runs = (
            [
                run
                for (name, ready, _), run in flown.items()
                if (name, ready) == (case.name, is_ready)
            ]
            for is_ready in (False, True)
        )
        if drawn_runs or ready_runs:
            rows.append(cells(case, drawn_runs, ready_runs))
            sys.stdout.write(" | ".join(rows[-1]) + "\n")
    return rows


MARGIN_HEADINGS = (
    "law alone of 60 drawn teams", "decays by 0.04/s", "delay margin 20 ms", "lag margin 25 ms", "all", "refused",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class MarginsAlone:
    """Growth of deviations of the hover of a team of UAVs alone, 1/s, and its margins of delay and lag, ms."""

    growth: float
    delay_ms: float
    lag_ms: float

    @property
    def met(self) -> tuple[bool, bool, bool]:
        """Which of the criteria hold: decay, delay, lag."""
        return self.growth < -DECAY_PER_S, self.delay_ms >= _DELAY_MS, self.lag_ms >= _LAG_MS

    def text(self) -> str:
        """Return the numbers in words."""
        return f"growth {self.growth:.3f}/s, delay {self.delay_ms:.0f} ms, lag {self.lag_ms:.0f} ms"


def margins_alone(setup: Setup, *, designed: bool) -> MarginsAlone:
    """Compute the margins with the gains designed for a team, or with those of rings."""
    team = setup.team_alone(next_tick=setup.scenario.clock.next_tick)
    gains = team.design().gains if designed else FAMILY[0]
    with threadpoolctl.threadpool_limits(1):
        loop = team.loop(gains)
        growth = loop.growth(Mismatch())
        ranges = margins(loop, ("delay_s", "lag_s"))
    if not ranges:  # of an unstable loop
        return MarginsAlone(growth, 0.0, 0.0)
    uppers_s = [math.inf if one.upper is None else one.upper for one in ranges.values()]
    return MarginsAlone(growth, *(1e3 * upper_s for upper_s in uppers_s))


def count_margins(*, first: int, each: bool) -> list[list[str]]:
    """Compute decay and margins of UAVs alone, with the designed gains and with those of rings, of 60 teams."""
    setups = []
    refused = 0
    for seed in range(first, first + 60):
        try:
            setups.append((seed, Setup.of(drawn(seed, *_template()), f"team {seed}")))
        except ScenarioError as error:
            sys.stdout.write(f"team {seed}: {error}\n")
            refused += 1

    rows = []
    for name, designed in (("designed for the team", True), ("gains of rings", False)):
        met = []
        for seed, setup in setups:
            found = margins_alone(setup, designed=designed)
            met.append(found.met)
            if each or (designed and not all(found.met)):
                sys.stdout.write(f"team {seed}: {found.text()}\n")
        counts = [*np.sum(met, axis=0), sum(map(all, met))]
        of = f"of {len(met)}"
        rows.append(
            [name, *(f"{number} {of}" for number in counts), f"{refused if designed else 0}"]
        )
        sys.stdout.write(" | ".join(rows[-1]) + "\n")
    return rows


def main(given: Sequence[str] | None = None) -> None:
    """Fly the cases, or compute the margins."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.teams", description=__doc__)
    parser.add_argument("--case", default="", help="text in the names of the cases to fly")
    parser.add_argument("--backwards", action="store_true", help="fly the last ones first")
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
    if options.margins:
        mark, rows = "bench: teams alone", count_margins(first=options.first, each=options.runs)
        headings: Sequence[str] = MARGIN_HEADINGS
    else:
        mark, rows, headings = "bench: teams", count(options), HEADINGS
    if options.write:
        put(
            ROOT / "docs" / "record" / "guarantees.md",
            mark,
            f"{table(headings, rows)}\n\n*{origin()}.*",
        )
        if not options.margins:
            short = [[cells[i] for i in _SHORT] for cells in (headings, *rows)]
            put(ROOT / "README.md", mark, table(short[0], short[1:]))


if __name__ == "__main__":
    main()
