"""Simulations behind the measured tables of documents: in memory, on all cores, kept for each commit.

A commit with complete results is not simulated again.
"""

import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import threadpoolctl
from tables import ROOT, commit, place, put

from protocol.scenario.setup import Setup
from protocol.wire.messages import Message
from transport.analysis.metrics import summarise
from transport.analysis.series import series_of
from transport.experiments.cases import Case, Point, Team, cases_of
from transport.experiments.workers import each_on_cores
from transport.flight import memory
from transport.flight.header import machine, versions
from transport.log.run_log import Recorded, RunLog

RESULTS = ROOT / "runs" / "figures" / "simulations"
DIVERGED = "diverged"


@dataclass(frozen=True, slots=True)
class Result:
    """Result of one simulation.

    Attributes:
        outcome: As in a summary.
        end_s: Scenario time of its end.
        phase: Phase of the maneuver in which it ended.
        cost_mean, cost_max, cost_max_settled: Cost of a tick; the last one after the first phase.
        attitude_deg: Largest payload attitude.
        uav_rms_m, uav_max_m, uav_last_m: Distance of the UAVs from their references: RMS, maximum, and maximum at the
            last tick.
        payload_rms_m, payload_max_m, swing_m: Distance of the payload from its reference.
        separation_m: Smallest distance of two UAVs.
        front_m: Largest x of a UAV.
    """

    outcome: str
    end_s: float
    phase: str
    cost_mean: float
    cost_max: float
    cost_max_settled: float
    attitude_deg: float
    uav_rms_m: float
    uav_max_m: float
    uav_last_m: float
    payload_rms_m: float
    payload_max_m: float
    swing_m: float
    separation_m: float
    front_m: float

    @property
    def completed(self) -> bool:
        """Whether the maneuver was completed."""
        return self.outcome == "completed"


@dataclass(frozen=True, slots=True)
class Run:
    """Simulations to run.

    Attributes:
        scenario: Name.
        settings: Changes to it.
        team: Team in place of the scenario's own.
        seeds: Number of seeds, from 0; 1 if nothing is random.
    """

    scenario: str
    settings: tuple[str, ...] = ()
    team: Team | None = None
    seeds: int = 1

    def cases(self) -> list[Case]:
        """Return the simulation for each seed."""
        point = Point(scenario=self.scenario, labels={}, text="team", settings=self.settings, team=self.team)
        return cases_of([point], (), self.seeds)


# Results by run, in the order of the seeds.
Found = Mapping[Run, Sequence[Result]]


@dataclass(frozen=True, slots=True)
class Measured:
    """A table of the document: name of its markers, simulations it needs, and the function that writes it."""

    name: str
    runs: tuple[Run, ...]
    text: Callable[[Found], str]


def number(value: float, digits: int = 2) -> str:
    """Return a number with so many digits behind the point."""
    return f"{value:.{digits}f}"


def significant(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits, without an exponent."""
    return np.format_float_positional(value, precision=digits, fractional=False, unique=False, trim="k").rstrip(".")


def attitude(result: Result) -> str:
    """Return the largest payload attitude."""
    return f"{result.attitude_deg:.2f} deg"


def cost(result: Result) -> str:
    """Return the mean cost."""
    return significant(result.cost_mean)


def or_diverged(result: Result, cell: Callable[[Result], str]) -> str:
    """Return a cell, or when the run diverged."""
    return cell(result) if result.completed else f"{DIVERGED} at {result.end_s:.0f} s ({result.phase})"


def one(found: Found, run: Run) -> Result:
    """Return the only result of a run."""
    (result,) = found[run]
    return result


def renew(document: Path, tables: Sequence[Measured]) -> None:
    """Simulate, and renew the tables of a document and the line that says where they come from.

    Raises: SystemExit: the document lacks markers.
    """
    for name in ("origin", *(part.name for part in tables)):
        place(document, name)  # refused before minutes are spent
    now, found = _results(document.name, [run for part in tables for run in part.runs])
    for part in tables:
        put(document, part.name, part.text(found))
    put(document, "origin", f"*Commit {now}; {versions()}; {machine()}.*")
    sys.stderr.write(f"written: {document.relative_to(ROOT)}\n")


def _results(title: str, runs: Sequence[Run]) -> tuple[str, Found]:
    """Run the missing simulations; return the commit and all results."""
    now = commit()
    kept = None if "changes" in now or now == "unknown" else RESULTS / f"{now}.jsonl"
    by_key: dict[str, Result] = {} if kept is None or not kept.exists() else _read(kept)
    cases = {run: run.cases() for run in dict.fromkeys(runs)}
    missing = {case.key: case for several in cases.values() for case in several if case.key not in by_key}
    # Large teams and long runs first: no core is idle while the last of them ends.
    order = sorted(missing.values(), key=_effort, reverse=True)
    for done, (key, result) in enumerate(each_on_cores(simulate, order, _jobs()) if order else (), start=1):
        by_key[key] = result
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            with kept.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"key": key, **asdict(result)}) + "\n")
        sys.stderr.write(f"\r{title}: {done} of {len(order)} simulations")
    sys.stderr.write("\n")
    return now, {run: [by_key[case.key] for case in several] for run, several in cases.items()}


def _read(kept: Path) -> dict[str, Result]:
    """Return kept results by key, without those that have other fields than today's."""
    names = {"key", *(field.name for field in fields(Result))}
    entries = [json.loads(line) for line in kept.read_text(encoding="utf-8").splitlines()]
    return {entry.pop("key"): Result(**entry) for entry in entries if entry.keys() == names}


def simulate(case: Case) -> tuple[str, Result]:
    """Simulate a case in this process; return its key with the result."""
    messages: list[Recorded] = []

    def record(message: Message) -> None:
        messages.append(Recorded(message=message, received_ns=0))

    with threadpoolctl.threadpool_limits(1):
        setup = Setup.of(case.scenario, case.source)
        control = memory.simulate(setup, record, lambda: 0)
        log = RunLog(header={}, messages=tuple(messages), cut="")
        summary, series = summarise(setup, log), series_of(setup, log)
    end_s = control.tick * setup.settings.sampling_period_s

    def value(*path: str) -> float:
        found = summary
        for name in path:
            found = found[name]
        return float("nan") if found is None else float(found)  # type: ignore[arg-type]

    return case.key, Result(
        outcome=control.outcome,
        end_s=end_s,
        phase=_phase(setup, end_s),
        cost_mean=value("cost", "mean"),
        cost_max=value("cost", "max"),
        cost_max_settled=value("cost", "max_after_hover"),
        attitude_deg=value("attitude_max_deg"),
        uav_rms_m=value("uav_tracking", "rms_m"),
        uav_max_m=value("uav_tracking", "max_m"),
        uav_last_m=float(np.linalg.norm(series.uav_errors_I[-1], axis=1).max()),
        payload_rms_m=value("payload_tracking", "rms_m"),
        payload_max_m=value("payload_tracking", "max_m"),
        swing_m=value("payload_tracking", "swing_m"),
        separation_m=value("separation_min_m"),
        front_m=float(series.uavs_I[:, :, 0].max()),
    )


def _phase(setup: Setup, time_s: float) -> str:
    """Return the phase at a time; of two with the same name, which one."""
    phases = setup.scenario.maneuver.phase
    ends_s = np.cumsum([phase.duration_s for phase in setup.maneuver.phases])
    index = min(int(np.searchsorted(ends_s, time_s - 1e-9)), len(phases) - 1)
    name = phases[index].name
    same = [i for i, phase in enumerate(phases) if phase.name == name]
    which = "first " if index == same[0] else "last " if index == same[-1] else ""
    return f"{which}{name}" if len(same) > 1 else name


def _effort(case: Case) -> float:
    """Return about how long a case takes, in any unit."""
    return float(len(case.scenario.system.uav) ** 2 * sum(p.duration_s or 0.0 for p in case.scenario.maneuver.phase))


def _jobs() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
