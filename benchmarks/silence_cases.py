"""Cases of silent networks (`python -m benchmarks.silence`): the settings of their runs, and when a silence begins."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from transport.experiments.weather_experiment import FORCES, SENSORS
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario

# The sensors of a small autopilot, forces estimated; plans 100 ms late.
VEHICLE = (*SENSORS, FORCES)
LATE = ("links.delay_s=0.1",)
_FROM_S = (4.0, 10.0)  # range of the instant at which the silence begins
BACK_S = 3.0  # after the silence, until the payload error is compared
_END_S = 5.0  # of the maneuver after that
FOR_GOOD = math.inf
_BEYOND_S = 1e5  # end of a silence for good
_INSTANTS = 44  # stream of the draws of the instants at which silences begin


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
    # Groups that do not hear the others; None: each agent alone.
    parts: tuple[tuple[str, ...], ...] | None = None
    links: tuple[str, ...] = ()  # further settings of the network
    from_start: bool = False  # no message from the first tick on
    compared: bool = True  # with the run without silence, and with "alone"


def cases() -> Iterator[Case]:
    """Yield the cases."""
    for speed_mps in (0.0, 1.0, 2.0):
        for silent_s in (1.0, 3.0, 10.0, 30.0, FOR_GOOD):
            yield _precise(speed_mps, _words(silent_s), silent_s=silent_s)
    for silent_s in (10.0, FOR_GOOD):
        yield Case(name=f"windy, {_words(silent_s)}", scenario="windy", silent_s=silent_s)
    yield Case(
        name="resilient, gusts 1 m/s, no plan",
        scenario="resilient",
        settings=gusts(1.0),
        links=("links.loss=1.0",),
        from_start=True,
        silent_s=FOR_GOOD,
    )
    yield Case(name="eight, still, 5 s", scenario="eight", silent_s=5.0)
    in_gusts = ("controller.disturbance.estimate=true", *gusts(1.0))
    yield Case(name="eight, gusts 1 m/s, 5 s", scenario="eight", settings=in_gusts, silent_s=5.0)

    # In part: nothing to compare with, as neither the run alone nor that without silence is its limit.
    partly = {"from_start": True, "silent_s": FOR_GOOD, "compared": False}
    for word, part in (("mute", "from"), ("deaf", "to")):
        override = f"links.override=[{{{part}='agent2', loss=1.0, delay_s=0.1}}]"
        yield _precise(1.0, f"one {word}", links=(override,), **partly)
    pairs = (("agent1", "agent2"),)
    yield _precise(1.0, "pairs 10 s", silent_s=10.0, parts=pairs, compared=False)
    for delay_s, loss in ((0.4, 0.6), (0.4, 0.9), (0.8, 0.0)):
        words = f"{1e3 * delay_s:.0f} ms and {100.0 * loss:.0f} % loss"
        links = (f"links.delay_s={delay_s}", f"links.loss={loss}")
        yield _precise(1.0, words, links=links, **partly)


def _precise(speed_mps: float, words: str, **given: Any) -> Case:
    """Return a case of `precise` with the sensors of the vehicles in gusts, m/s, and further fields."""
    name = f"precise, gusts {speed_mps:g} m/s, {words}"
    return Case(name=name, scenario="precise", settings=(*VEHICLE, *gusts(speed_mps)), **given)


def _words(silent_s: float) -> str:
    return "for good" if math.isinf(silent_s) else f"{silent_s:g} s"


def begins(case: Case, seed: int) -> float:
    """Return the instant at which the silence of a run begins, s: drawn from its seed."""
    if case.from_start:
        return 0.0
    return float(np.random.default_rng([seed, _INSTANTS]).uniform(*_FROM_S))


def network(case: Case, seed: int, agents: int) -> tuple[str, ...]:
    """Return the settings of the network of a run."""
    if case.from_start or case.silent_s == 0.0:
        return (*LATE, *case.links)
    start_s = begins(case, seed)
    end_s = start_s + case.silent_s if math.isfinite(case.silent_s) else _BEYOND_S
    parts = case.parts or tuple((f"agent{agent}",) for agent in range(1, agents))
    cuts = [f"{{between={list(part)!r}, start_s={start_s!r}, end_s={end_s!r}}}" for part in parts]
    return (*LATE, *case.links, f"links.partition=[{', '.join(cuts)}]")


def longer_hover(case: Case) -> tuple[str, ...]:
    """Return the setting of a hover after the maneuver, where the silence takes longer than that."""
    scenario = read_scenario(find_scenario(case.scenario), [])
    phases = [phase.model_dump(exclude_none=True) for phase in scenario.maneuver.phase]
    needed_s = _FROM_S[1] + case.silent_s + BACK_S + _END_S
    total_s = sum(phase["duration_s"] for phase in phases)
    if case.scenario == "eight" or math.isinf(case.silent_s) or needed_s <= total_s:
        return ()

    hover = {"name": "after", "duration_s": needed_s - total_s, "displacement_m": [0, 0, 0]}
    entries = [
        f"{{name='{one['name']}', duration_s={one['duration_s']}, displacement_m={list(one['displacement_m'])}}}"
        for one in (*phases, hover)
    ]
    return (f"maneuver.phase=[{', '.join(entries)}]",)
