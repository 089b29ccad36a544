"""Silent networks: `python -m benchmarks.silence` flies teams without messages for a while, or for good, or in part.

Each case is flown with seeds; the instant at which the silence begins is drawn from the seed. The
payload errors are root mean squares over the intervals of all seeds together: during the silence,
beside the same intervals of the controller "alone" and of the run without silence; and from 3 s after
it to the end of the run, beside the run without silence. A ratio of sums is that of what a user sees:
a mean of ratios would weigh a seed by how little it errs without silence.

One line for each case, `--runs` for each run; `--case TEXT` selects cases. `--kept FOLDER` keeps the
runs of these sources, and flies only those not kept there; `--write` renews the table in
docs/guarantees.md, with the number of seeds of each row, or with `--case` its rows of those cases.
"""

import argparse
import hashlib
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.runs import origin
from docs.tables import FLOWN, ROOT, place, put, table
from transport.experiments.weather_experiment import FORCES, SENSORS
from transport.flight.memory import simulate
from transport.flight.progress import compile_models
from transport.model.arrays import Array
from transport.model.state import R0, THETA0
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message, Note, PlantState

# The sensors of a small autopilot, forces estimated; plans 100 ms late.
VEHICLE = (*SENSORS, FORCES)
LATE = ("links.delay_s=0.1",)
ALONE = ("agents.controller=alone",)
_FROM_S = (4.0, 10.0)  # range of the instant at which the silence begins
_BACK_S = 3.0  # after the silence, until the payload error is compared
_END_S = 5.0  # of the maneuver after that
FOR_GOOD = math.inf


def gusts(speed_mps: float) -> tuple[str, ...]:
    """Return the settings of gusts of a standard deviation, m/s."""
    return (f"plant.wind.gust_mps=[{speed_mps!r}, {speed_mps!r}, {speed_mps!r}]",)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A team whose network is silent, in whole or in part."""

    name: str
    scenario: str
    settings: tuple[str, ...] = ()
    silent_s: float = 0.0  # duration; 0 for none
    parts: tuple[tuple[str, ...], ...] | None = (
        None  # groups that do not hear the others; None: each agent alone
    )
    links: tuple[str, ...] = ()  # further settings of the network
    from_start: bool = False  # no message from the first tick on
    compared: bool = True  # with the run without silence, and with "alone"


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
        """Return the squared payload errors over an interval, by tick, m^2."""
        first = round(begin_s / self.period_s)
        last = round(min(end_s, 1e6) / self.period_s)
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
    after: Errors = field(default_factory=Errors)  # from 3 s after the silence on
    resets: int = 0


def cases() -> Iterator[Case]:
    """Yield the cases."""
    for speed in (0.0, 1.0, 2.0):
        for silent_s in (1.0, 3.0, 10.0, 30.0, FOR_GOOD):
            name = f"precise, gusts {speed:g} m/s, {_words(silent_s)}"
            yield Case(
                name=name, scenario="precise", settings=(*VEHICLE, *gusts(speed)), silent_s=silent_s
            )
    for silent_s in (10.0, FOR_GOOD):
        yield Case(name=f"windy, {_words(silent_s)}", scenario="windy", silent_s=silent_s)
    yield Case(
        name="resilient, gusts 1 m/s, no plan", scenario="resilient", settings=gusts(1.0), links=("links.loss=1.0",),
        from_start=True, silent_s=FOR_GOOD,
    )  # fmt: skip
    yield Case(name="eight, still, 5 s", scenario="eight", silent_s=5.0)
    in_gusts = ("controller.disturbance.estimate=true", *gusts(1.0))
    yield Case(name="eight, gusts 1 m/s, 5 s", scenario="eight", settings=in_gusts, silent_s=5.0)
    for word, part in (("mute", "from"), ("deaf", "to")):
        override = f"links.override=[{{{part}='agent2', loss=1.0, delay_s=0.1}}]"
        yield Case(
            name=f"precise, gusts 1 m/s, one {word}", scenario="precise", settings=(*VEHICLE, *gusts(1.0)),
            links=(override,), from_start=True, silent_s=FOR_GOOD, compared=False,
        )  # fmt: skip
    pairs = (("agent1", "agent2"),)
    yield Case(
        name="precise, gusts 1 m/s, pairs 10 s", scenario="precise", settings=(*VEHICLE, *gusts(1.0)), silent_s=10.0,
        parts=pairs, compared=False,
    )  # fmt: skip
    for delay_s, loss in ((0.4, 0.6), (0.4, 0.9), (0.8, 0.0)):
        network_words = f"{1e3 * delay_s:.0f} ms and {100.0 * loss:.0f} % loss"
        yield Case(
            name=f"precise, gusts 1 m/s, {network_words}",
            scenario="precise",
            settings=(*VEHICLE, *gusts(1.0)),
            links=(f"links.delay_s={delay_s}", f"links.loss={loss}"),
            from_start=True,
            silent_s=FOR_GOOD,
            compared=False,
        )


def _words(silent_s: float) -> str:
    return "for good" if math.isinf(silent_s) else f"{silent_s:g} s"


def begins(case: Case, seed: int) -> float:
    """Return the instant at which the silence of a run begins, s: drawn from its seed."""
    if case.from_start:
        return 0.0
    return float(np.random.default_rng([seed, 44]).uniform(*_FROM_S))


def network(case: Case, seed: int, agents: int) -> tuple[str, ...]:
    """Return the settings of the network of a run."""
    if case.from_start or case.silent_s == 0.0:
        return (*LATE, *case.links)
    start_s = begins(case, seed)
    end_s = start_s + case.silent_s if math.isfinite(case.silent_s) else 1e5
    parts = case.parts or tuple((f"agent{agent}",) for agent in range(1, agents))
    cuts = [f"{{between={list(part)!r}, start_s={start_s!r}, end_s={end_s!r}}}" for part in parts]
    return (*LATE, *case.links, f"links.partition=[{', '.join(cuts)}]")


def _phases(case: Case) -> tuple[str, ...]:
    """Return a longer last hover where the silence takes longer than the maneuver."""
    scenario = read_scenario(find_scenario(case.scenario), [])
    phases = [phase.model_dump(exclude_none=True) for phase in scenario.maneuver.phase]
    needed_s = _FROM_S[1] + case.silent_s + _BACK_S + _END_S
    total_s = sum(phase["duration_s"] for phase in phases)
    if case.scenario == "eight" or math.isinf(case.silent_s) or needed_s <= total_s:
        return ()
    added_s = needed_s - total_s
    moves = [
        f"{{name='{p['name']}', duration_s={p['duration_s']}, displacement_m={list(p['displacement_m'])}}}"
        for p in phases
    ]
    hover = f"{{name='after', duration_s={added_s}, displacement_m=[0, 0, 0]}}"
    return (f"maneuver.phase=[{', '.join([*moves, hover])}]",)


NUMBERS = ("error_m", "attitude_deg", "separation_m")


@lru_cache(maxsize=1)
def _of_sources() -> str:
    """Return a digest of the sources that decide the numbers of a run."""
    digest = hashlib.sha256()
    files = [Path(__file__)]
    for source in FLOWN:
        place = ROOT / source
        files += [place] if place.is_file() else sorted(place.rglob("*"))
    for path in files:
        if path.suffix in {".py", ".c", ".toml"}:
            digest.update(path.read_bytes())
    return digest.hexdigest()


@dataclass(frozen=True, slots=True)
class Kept:
    """Runs in a folder, or in none: each is flown once for these sources."""

    folder: Path | None
    is_flying: bool = True  # otherwise only kept runs count

    def fly(self, scenario: str, settings: tuple[str, ...]) -> Flown | None:
        """Return a run, flown or kept; None where it is neither."""
        if self.folder is None:
            return fly(scenario, settings)
        named = repr((_of_sources(), scenario, settings)).encode()
        path = self.folder / f"{hashlib.sha256(named).hexdigest()[:24]}.npz"
        if not path.exists():
            if not self.is_flying:
                return None
            self._keep(path, fly(scenario, settings))
        return self._read(path)

    @staticmethod
    def _keep(path: Path, flown: Flown) -> None:
        """Write a run to a file, whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        with part.open("wb") as opened:
            np.savez(
                opened,
                said=np.array([flown.outcome, flown.reason]),
                numbers=np.array([flown.resets, flown.period_s]),
                **{name: getattr(flown, name) for name in NUMBERS},
            )
        part.replace(path)

    @staticmethod
    def _read(path: Path) -> Flown:
        """Return a run from its file."""
        with np.load(path) as kept:
            outcome, reason = kept["said"].tolist()
            resets, period_s = kept["numbers"].tolist()
            series = {name: kept[name] for name in NUMBERS}
        return Flown(
            outcome=outcome, reason=reason, resets=int(resets), period_s=period_s, **series
        )


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


def trio(case: Case, seed: int, kept: Kept) -> Trio | None:
    """Return the runs of a case with a seed; None where one is not kept and none are flown."""
    agents = len(read_scenario(find_scenario(case.scenario), []).owned)
    same = (*case.settings, *_phases(case), f"seed={seed}")
    flown = kept.fly(case.scenario, (*same, *network(case, seed, agents)))
    if flown is None:
        return None
    alone = undisturbed = None
    if case.compared:
        alone = kept.fly(case.scenario, (*same, *ALONE))
        undisturbed = kept.fly(case.scenario, (*same, *LATE))
        if alone is None or undisturbed is None:
            return None
    return Trio(flown=flown, alone=alone, undisturbed=undisturbed)


def run(case: Case, seeds: Sequence[int], kept: Kept, *, each: bool = False) -> Result:
    """Return the result of a case with seeds."""
    result = Result()
    for seed in seeds:
        runs = trio(case, seed, kept)
        if runs is None:
            continue
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
        intervals.append((result.after, end_s + _BACK_S, FOR_GOOD))
    for errors, first_s, last_s in intervals:
        errors.flown.append(flown.squares(first_s, last_s))
        if runs.alone is not None and runs.undisturbed is not None:
            errors.alone.append(runs.alone.squares(first_s, last_s))
            errors.undisturbed.append(runs.undisturbed.squares(first_s, last_s))


HEADINGS = (
    "case", "complete", "attitude at most", "UAVs apart", "payload error in the silence",
    "alone", "without silence", "from 3 s after it", "without silence",
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
    """Renew the table in docs/guarantees.md; with `only` the rows whose names contain that text."""
    document = ROOT / "docs" / "guarantees.md"
    renewed = {case.name: [case.name, *_cells(result)] for case, result in results if result.runs}
    source = origin()
    if only:
        whole, _, earlier = place(document, "bench: silence").group().partition("\n\n")
        for line in whole.splitlines()[2:]:
            cells = line.strip("| ").split(" | ")
            renewed.setdefault(cells[0], cells)
        of_others = earlier.strip("*.").split("; rows with ")[0]
        source = f"{of_others}; rows with {only!r}: {source}"
    rows = [renewed[case.name] for case in cases() if case.name in renewed]
    put(document, "bench: silence", f"{table(HEADINGS, rows)}\n\n*{source}.*")


def main(given: Sequence[str] | None = None) -> None:
    """Fly the cases and print their lines."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.silence", description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds of each case")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--case", default="", help="text in the names of the cases to fly")
    parser.add_argument("--runs", action="store_true", help="print a line for each run")
    parser.add_argument("--kept", type=Path, help="folder of runs of these sources")
    parser.add_argument("--no-fly", action="store_true", help="count kept runs alone")
    parser.add_argument("--write", action="store_true", help="renew the table of the page")
    options = parser.parse_args(given)
    if options.write and options.no_fly:
        parser.error("--write: expected no --no-fly, as it renews rows whole")
    seeds = range(options.first, options.first + options.seeds)
    kept = Kept(options.kept, is_flying=not options.no_fly)
    results = []
    for case in cases():
        if options.case in case.name:
            result = run(case, seeds, kept, each=options.runs)
            results.append((case, result))
            if result.runs:
                sys.stdout.write(said(case, result) + "\n")
                sys.stdout.flush()
    if options.write:
        write(results, only=options.case)


if __name__ == "__main__":
    main(sys.argv[1:])
