"""Silent networks: `python -m benchmarks.silence` flies teams without messages for a while, or for good, or in part.

Each case is flown with seeds; the instant at which the silence begins is drawn from the seed. The
payload errors are root mean squares over the intervals of all seeds together: during the silence,
beside the same intervals of the controller "alone" and of the run without silence; and from 3 s after
it to the end of the run, beside the run without silence. A ratio of sums is that of what a user sees:
a mean of ratios would weigh a seed by how little it errs without silence.

One line for each case, `--runs` for each run; `--case TEXT` selects cases. `--write` renews each row
of the table in docs/record/guarantees.md as soon as its runs are done; the table says which rows are new:
where it names a row twice, the later origin is that of the row.
"""

import argparse
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations

import numpy as np
from rich.console import Console

from benchmarks.runs import origin
from benchmarks.silence_cases import (
    BACK_S,
    FOR_GOOD,
    LATE,
    Case,
    begins,
    cases,
    longer_hover,
    network,
)
from docs.tables import ROOT, place, put_rows
from transport.flight.memory import simulate
from transport.flight.progress import compile_models
from transport.model.arrays import Array
from transport.model.state import R0, THETA0
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message, Note, PlantState

ALONE = ("agents.controller=alone",)


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """Ground truth of a run."""

    outcome: str
    reason: str
    error_m: Array  # of the payload, by tick
    attitude_deg: Array
    separation_m: Array
    resets: int
    period_s: float

    def squares(self, begin_s: float, end_s: float) -> Array:
        """Return the squared payload errors over an interval, by tick, m^2; to the end of the run if infinite."""
        first = round(begin_s / self.period_s)
        last = round(end_s / self.period_s) if math.isfinite(end_s) else None
        return np.asarray(self.error_m[first:last] ** 2)


@dataclass(slots=True, kw_only=True)
class Errors:
    """Squared payload errors of all runs of a case over an interval, m^2."""

    flown: list[Array] = field(default_factory=list)
    alone: list[Array] = field(default_factory=list)
    undisturbed: list[Array] = field(default_factory=list)  # without silence

    def rms(self) -> tuple[float, float, float]:
        """Return the errors in silence, alone and without silence, m rms; nan without runs."""
        flown, alone, undisturbed = map(_rms, (self.flown, self.alone, self.undisturbed))
        return flown, alone, undisturbed


def _rms(squares: Sequence[Array]) -> float:
    """Return the root mean square of all instants of all runs; nan without any."""
    joined = np.concatenate([*squares, np.zeros(0)])
    return float(np.sqrt(joined.mean())) if len(joined) else math.nan


@dataclass(slots=True, kw_only=True)
class Result:
    """Worst values of the runs of a case, and its payload errors."""

    runs: int = 0
    completed: int = 0
    attitude_deg: float = 0.0
    separation_m: float = math.inf
    during: Errors = field(default_factory=Errors)
    after: Errors = field(default_factory=Errors)  # from `BACK_S` after the silence on
    resets: int = 0


@lru_cache(maxsize=256)
def fly(scenario: str, settings: tuple[str, ...]) -> Flown:
    """Fly a scenario with settings."""
    path = find_scenario(scenario)
    flown = read_scenario(path, list(settings))
    compile_models([flown], Console(stderr=True))
    setup = Setup.of(flown, path.name)
    states: dict[int, Array] = {}
    resets = 0

    def record(message: Message) -> None:
        nonlocal resets
        if isinstance(message, PlantState):
            states[message.tick] = message.x
        elif isinstance(message, Note) and message.problem.startswith("filter:"):
            resets += 1

    end = simulate(setup, record)
    X = np.array([states[tick] for tick in sorted(states)])
    period_s = setup.settings.sampling_period_s
    wanted, _ = setup.maneuver.path(period_s * np.arange(len(X), dtype=np.float64))
    places = setup.model.outputs_along(X)[:, : 3 * setup.system.N].reshape(len(X), -1, 3)
    pairs = combinations(range(setup.system.N), 2)
    apart_m = [np.linalg.norm(places[:, a] - places[:, b], axis=1) for a, b in pairs]
    return Flown(
        outcome=end.outcome,
        reason=end.reason,
        error_m=np.linalg.norm(X[:, R0] - wanted, axis=1),
        attitude_deg=np.degrees(np.abs(X[:, THETA0]).max(axis=1)),
        separation_m=np.min(apart_m, axis=0),
        resets=resets,
        period_s=period_s,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Trio:
    """The runs of a case with one seed: in silence, alone and without silence."""

    flown: Flown
    alone: Flown | None
    undisturbed: Flown | None


def trio(case: Case, seed: int) -> Trio:
    """Return the runs of a case with a seed."""
    agents = len(read_scenario(find_scenario(case.scenario), []).owned)
    same = (*case.settings, *longer_hover(case), f"seed={seed}")
    return Trio(
        flown=fly(case.scenario, (*same, *network(case, seed, agents))),
        alone=fly(case.scenario, (*same, *ALONE)) if case.compared else None,
        undisturbed=fly(case.scenario, (*same, *LATE)) if case.compared else None,
    )


def run(case: Case, seeds: Sequence[int], *, each: bool = False) -> Result:
    """Return the result of a case with seeds."""
    result = Result()
    for seed in seeds:
        runs = trio(case, seed)
        one = Result()
        for to in (one, result):
            _count(case, seed, runs, to)
        if each:
            begun = f"  seed {seed}: from {begins(case, seed):.2f} s"
            reason = f" {runs.flown.reason}".rstrip()
            sys.stdout.write(f"{begun}, {', '.join(_cells(one))}{reason}\n")
            sys.stdout.flush()
    return result


def _count(case: Case, seed: int, runs: Trio, result: Result) -> None:
    """Add the runs of a seed to a result."""
    flown = runs.flown
    result.runs += 1
    result.completed += flown.outcome == "completed"
    result.attitude_deg = max(result.attitude_deg, float(flown.attitude_deg.max()))
    result.separation_m = min(result.separation_m, float(flown.separation_m.min()))
    result.resets += flown.resets

    begin_s = begins(case, seed)
    end_s = begin_s + case.silent_s
    intervals = [(result.during, begin_s, end_s)]
    if math.isfinite(case.silent_s) and not case.from_start:
        intervals.append((result.after, end_s + BACK_S, FOR_GOOD))
    for errors, first_s, last_s in intervals:
        errors.flown.append(flown.squares(first_s, last_s))
        if runs.alone is not None and runs.undisturbed is not None:
            errors.alone.append(runs.alone.squares(first_s, last_s))
            errors.undisturbed.append(runs.undisturbed.squares(first_s, last_s))


HEADINGS = (
    "case", "complete", "attitude at most", "UAVs apart", "payload error in the silence",
    "alone", "without silence", f"from {BACK_S:g} s after it", "without silence",
)  # fmt: skip


def _cells(result: Result) -> list[str]:
    """Return what is said of a result: the cells of a row but the first."""
    resets = f", {result.resets} resets of filters" if result.resets else ""
    during, alone, undisturbed = result.during.rms()
    after, _, back = result.after.rms()
    return [
        f"{result.completed} of {result.runs}{resets}",
        f"{result.attitude_deg:.1f} deg",
        f"{result.separation_m:.3f} m",
        f"{during:.3f} m",
        _beside(during, alone),
        _beside(during, undisturbed),
        "-" if math.isnan(after) else f"{after:.3f} m",
        _beside(after, back),
    ]


def _beside(error_m: float, other_m: float) -> str:
    """Return another error, and by what factor the one exceeds it."""
    return "-" if math.isnan(other_m) else f"{other_m:.3f} m (x{error_m / other_m:.2f})"


def said(case: Case, result: Result) -> str:
    """Return the line of a case."""
    named = zip(HEADINGS[1:], _cells(result), strict=True)
    return f"{case.name}: " + ", ".join(f"{heading} {cell}" for heading, cell in named)


def write(results: Sequence[tuple[Case, Result]], *, only: str) -> None:
    """Renew rows in docs/record/guarantees.md; the others stay, and the table says which rows are new.

    Args:
        results: Cases with their results so far.
        only: Text in the names of the cases that the command flies; empty for all.
    """
    document = ROOT / "docs" / "record" / "guarantees.md"
    whole, _, earlier = place(document, "bench: silence").group().partition("\n\n")
    rows = {case.name: _cells(result) for case, result in results}
    order = [case.name for case in cases()]

    source = origin()
    count = len({line.split(" | ")[0].strip("| ") for line in whole.splitlines()[2:]} | rows.keys())
    if len(results) < count:
        base, *parts = earlier.strip("*.").split("; rows ")
        stay = [part for part in parts if not _rows_of(part, order) <= rows.keys()]
        new = f"with {only!r}" if only else ""
        if not _rows_of(f"{new}:", order) <= rows.keys():
            new = f"{new} up to {results[-1][0].name!r}".lstrip()
        source = "; rows ".join([base, *stay, f"{new}: {source}"])
    put_rows(document, "bench: silence", HEADINGS, order, rows, source)


def _rows_of(part: str, order: Sequence[str]) -> set[str]:
    """Return the rows that a part of the origin names: "with 'TEXT' up to 'LAST': ...", or one of both."""
    named = re.match(r"(?:with '(.*?)')? ?(?:up to '(.*?)')?:", part)
    text, last = named.groups("") if named else ("", "")
    shown = order[: order.index(last) + 1] if last in order else order
    return {name for name in shown if text in name}


def main(given: Sequence[str] | None = None) -> None:
    """Fly the cases and print their lines."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.silence", description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds of each case")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--case", default="", help="text in the names of the cases to fly")
    parser.add_argument("--runs", action="store_true", help="print a line for each run")
    parser.add_argument("--write", action="store_true", help="renew the rows of the page")
    options = parser.parse_args(given)
    seeds = range(options.first, options.first + options.seeds)
    results = []
    for case in cases():
        if options.case in case.name:
            results.append((case, run(case, seeds, each=options.runs)))
            sys.stdout.write(said(*results[-1]) + "\n")
            sys.stdout.flush()
            if options.write:
                write(results, only=options.case)


if __name__ == "__main__":
    main(sys.argv[1:])
