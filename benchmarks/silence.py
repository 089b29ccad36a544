"""Silent networks: `python -m benchmarks.silence` flies teams without messages for a while, or for good, or in part.

Each case is flown with seeds; the instant at which the silence begins is drawn from the seed. The
payload error during the silence is compared with that of the controller "alone" at the same time in
the same weather, the error from 3 s after it on with that of the run without silence. One line for
each case, `--runs` for each run; `--case TEXT` selects cases.
"""

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations

import numpy as np

from transport.flight.memory import simulate
from transport.model.arrays import Array
from transport.model.state import R0, THETA0
from transport.protocol.scenario.file import find_scenario, read_scenario
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import Message, Note, PlantState

# The sensors of a small autopilot with satellite navigation, forces estimated, plans 100 ms late.
VEHICLE = (
    "plant.sensors=vehicle",
    "controller.estimator=kalman",
    "controller.disturbance.estimate=true",
    "plant.noise.position_m=0.01",
    "plant.noise.velocity_mps=0.02",
    "plant.noise.attitude_rad=0.0087",
    "plant.noise.rate_rads=0.0175",
    "plant.noise.specific_force_mps2=0.3",
)
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

    def rms(self, begin_s: float, end_s: float) -> float:
        """Return the payload error over an interval, m rms; nan without data."""
        part = self.error_m[
            round(begin_s / self.period_s) : min(
                len(self.error_m), round(min(end_s, 1e6) / self.period_s)
            )
        ]
        return float(np.sqrt(np.mean(part**2))) if len(part) else math.nan


@dataclass(slots=True, kw_only=True)
class Result:
    """Worst values of the runs of a case."""

    runs: int = 0
    completed: int = 0
    attitude_deg: float = 0.0
    separation_m: float = math.inf
    during_m: list[float] = field(default_factory=list)  # payload error in the silence
    alone: list[float] = field(default_factory=list)  # over that of "alone"
    after: list[float] = field(
        default_factory=list
    )  # payload error after it over that without silence
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
    yield Case(
        name="precise, gusts 1 m/s, 400 ms and 90 % loss", scenario="precise", settings=(*VEHICLE, *gusts(1.0)),
        links=("links.delay_s=0.4", "links.loss=0.9"), from_start=True, silent_s=FOR_GOOD, compared=False,
    )  # fmt: skip


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


@lru_cache(maxsize=256)
def fly(scenario: str, settings: tuple[str, ...]) -> Flown:
    """Fly a scenario with settings."""
    path = find_scenario(scenario)
    setup = Setup.of(read_scenario(path, list(settings)), path.name)
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


def run(case: Case, seeds: Sequence[int], *, each: bool) -> Result:
    """Fly a case with seeds."""
    result = Result()
    agents = len(read_scenario(find_scenario(case.scenario), []).owned)
    for seed in seeds:
        same = (*case.settings, *_phases(case), f"seed={seed}")
        flown = fly(case.scenario, (*same, *network(case, seed, agents)))
        begin_s = begins(case, seed)
        end_s = begin_s + case.silent_s
        result.runs += 1
        result.completed += flown.outcome == "completed"
        result.attitude_deg = max(result.attitude_deg, float(flown.attitude_deg.max()))
        result.separation_m = min(result.separation_m, float(flown.separation_m.min()))
        result.resets += flown.resets
        result.during_m.append(flown.rms(begin_s, end_s))
        if case.compared:
            alone = fly(case.scenario, (*same, *ALONE))
            result.alone.append(flown.rms(begin_s, end_s) / alone.rms(begin_s, end_s))
        if case.compared and math.isfinite(case.silent_s) and not case.from_start:
            undisturbed = fly(case.scenario, (*same, *LATE))
            late_s = end_s + _BACK_S
            result.after.append(flown.rms(late_s, FOR_GOOD) / undisturbed.rms(late_s, FOR_GOOD))
        if each:
            worst = f"{flown.attitude_deg.max():.1f} deg, {flown.separation_m.min():.3f} m"
            numbers = f"{worst}, {result.during_m[-1]:.3f} m"
            ratios = f"alone x{(result.alone or [math.nan])[-1]:.2f}, after x{(result.after or [math.nan])[-1]:.2f}"
            said = f"  seed {seed}: from {begin_s:.2f} s, {flown.outcome}, {numbers}, {ratios}, {flown.resets} resets"
            sys.stdout.write(f"{said} {flown.reason}".rstrip() + "\n")
            sys.stdout.flush()
    return result


def said(case: Case, result: Result) -> str:
    """Return the line of a case."""
    line = (
        f"{case.name}: {result.completed}/{result.runs} complete, {result.attitude_deg:.1f} deg, "
        f"{result.separation_m:.3f} m apart, payload {np.mean(result.during_m):.3f} m rms"
    )
    if result.alone:
        line += f", x{np.mean(result.alone):.2f} (at most {max(result.alone):.2f}) of alone"
    if result.after:
        line += f", after x{np.mean(result.after):.2f} (at most {max(result.after):.2f})"
    return line + (f", {result.resets} resets of filters" if result.resets else "")


def main(given: Sequence[str] | None = None) -> None:
    """Fly the cases and print their lines."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.silence", description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds of each case")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--case", default="", help="text in the names of the cases to fly")
    parser.add_argument("--runs", action="store_true", help="print a line for each run")
    options = parser.parse_args(given)
    seeds = range(options.first, options.first + options.seeds)
    for case in cases():
        if options.case in case.name:
            sys.stdout.write(said(case, run(case, seeds, each=options.runs)) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
