"""Comparison of centralized and distributed control: controllers, their grid of periods, and their processor time."""

import itertools
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import orjson
import threadpoolctl

from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.setup import Setup
from protocol.wire.messages import Message, StepReport
from transport.experiments.cases import Point, refused
from transport.experiments.declaration import QUICK_MANEUVER, Declaration, Experiment, axis
from transport.flight import memory
from transport.report.report import write_whole

NAME = "paper"

# The paper publishes no weights: its algorithm is run with ours.
CENTRALIZED, PAPER, CLOSED_LOOP = "centralized", "paper's algorithm", "closed loop"
SCENARIOS = {CENTRALIZED: "centralized", PAPER: "paper", CLOSED_LOOP: "paper"}
# The controller of `resilient` with the weights of the others: costs under different weights do not compare.
_CLOSED_LOOP = (
    "controller.prediction=closed_loop",
    "controller.linearisation=along",
    "controller.terminal=riccati",
    "controller.preview=true",
    "controller.received_plans=by_age",
    "controller.relaxation=0.5",
)
STEPS, SECONDS = "steps", "seconds"
STILL, GUSTS = "still air", "gusts"

# The curves: a controller, and whether its horizon keeps the reference's number of steps or of seconds; with the
# shortest period over the reference's. Below it an agent computes more than the reference, and the long horizons take
# more time than all other runs together.
CURVES = {
    (CENTRALIZED, STEPS): 0.0,
    (CENTRALIZED, SECONDS): 0.5,
    (PAPER, STEPS): 0.0,
    (PAPER, SECONDS): 0.4,
    (CLOSED_LOOP, SECONDS): 0.4,
}

# Sampling periods over the reference's: 100 to 15 ms for the paper's 50 ms.
GRID, QUICK_GRID = (2.0, 1.5, 1.0, 0.7, 0.5, 0.4, 0.3), (1.0, 0.5)

# Budgets of computation: the whole team or one agent.
TEAM, AGENT = "whole team", "one agent"

# Repetitions of a measurement, and first ticks of each run that are not counted: caches and solvers warm up. Its
# maneuver is long enough to settle, short enough that both runs of a pair see the same machine.
_REPEATS, _QUICK_REPEATS, _WARM_UP = 5, 1, 3
MANEUVER = QUICK_MANEUVER
_QUICK_MEASUREMENT = "maneuver.phase=[{name='climb',duration_s=0.4,displacement_m=[0,0,-0.2]}]"

_COMPUTATION = "computation.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A controller at one sampling period."""

    controller: str
    period_s: float  # T_s
    horizon: int  # N_p, steps


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """Measured processor time of a controller at one sampling period, beside that of the reference.

    The single agent of the reference computes for the team.
    """

    controller: str
    period_s: float  # sampling period T_s
    horizon: int  # N_p, steps
    agents: int  # number of agents
    reference_period_s: float
    step_ms: Sequence[float]  # mean processor time of an agent's step in each repetition, ms
    reference_step_ms: Sequence[float]  # the same of the reference, measured immediately before, ms

    def seconds_per_second(self, budget: str) -> list[float]:
        """Return processor time per simulated second in each repetition, s/s."""
        return [self._agents(budget) * step_ms / 1e3 / self.period_s for step_ms in self.step_ms]

    def ratios(self, budget: str) -> list[float]:
        """Return processor time per simulated second over the reference's, in each repetition."""
        rate = self._agents(budget) * self.reference_period_s / self.period_s
        return [rate * own / first for own, first in zip(self.step_ms, self.reference_step_ms, strict=True)]

    def _agents(self, budget: str) -> int:
        return self.agents if budget == TEAM else 1


Curves = Mapping[tuple[str, str], Sequence[Cell]]
Loads = Mapping[Cell, Load]


@dataclass(frozen=True, slots=True)
class PeriodRange:
    """Range of sampling periods, s, over several repetitions.

    The low end is 0 if a repetition computes less than the reference even at the shortest measured period; the high end
    is infinite if one computes more even at the longest.
    """

    low_s: float
    high_s: float

    @property
    def is_open(self) -> bool:
        """Whether an end is outside the measured periods."""
        return self.low_s == 0.0 or math.isinf(self.high_s)


def curves_of(period_s: float, horizon: int, *, quick: bool = False) -> Curves:
    """Return the cells of each curve by controller and kept horizon, from the longest period to the shortest.

    Sampling period, s, and horizon, steps, are those of the reference; quick gives two periods only.
    """

    def cell(controller: str, kept: str, own_s: float) -> Cell:
        steps = horizon if kept == STEPS else max(1, round(horizon * period_s / own_s))
        return Cell(controller=controller, period_s=own_s, horizon=steps)

    return {
        (controller, kept): [
            cell(controller, kept, round(factor * period_s, 6))
            for factor in (QUICK_GRID if quick else GRID)
            if factor >= shortest
        ]
        for (controller, kept), shortest in CURVES.items()
    }


def cells_of(curves: Curves) -> list[Cell]:
    """Return every cell once; two curves of a controller meet at the reference's period."""
    return list(dict.fromkeys(cell for cells in curves.values() for cell in cells))


def setup_of(controller: str, settings: Sequence[str]) -> Setup:
    """Return the run of a controller.

    Raises: ScenarioError: wrong settings, or a centralized controller with more than one agent.
    """
    path = find_scenario(SCENARIOS[controller])
    setup = Setup.of(read_scenario(path, settings), str(path))
    if controller == CENTRALIZED and len(setup.agents) > 1:
        raise ScenarioError(str(path), "agents.owned", f"expected one agent that owns all, got {len(setup.agents)}")
    return setup


def at_rate(cell: Cell) -> tuple[str, ...]:
    """Return the settings of a cell: controller, sampling period, horizon, and a plant step of at most one period."""
    law = _CLOSED_LOOP if cell.controller == CLOSED_LOOP else ()
    rate = f"controller.sampling_period_s={cell.period_s!r}", f"controller.horizon={cell.horizon}"
    return (*law, *rate, *([f"plant.step_s={cell.period_s!r}"] if cell.period_s < 0.01 else []))


def experiment(cells: Sequence[Cell], reference: Cell, gust_mps: float) -> Experiment:
    """Return the sweep: every cell in still air and, unless their standard deviation in m/s is zero, in gusts."""
    weathers = {STILL: "plant.wind.gust_mps=[0.0,0.0,0.0]"}
    if gust_mps > 0.0:
        weathers[GUSTS] = f"plant.wind.gust_mps=[{gust_mps!r},{gust_mps!r},{gust_mps!r}]"
    points = [
        Point(
            scenario=SCENARIOS[cell.controller],
            labels={"weather": weather, **asdict(cell)},
            text=f"{1e3 * cell.period_s:g} ms x {cell.horizon}, {weather}",
            settings=(*at_rate(cell), setting),
            baseline=cell == reference,
        )
        for weather, setting in weathers.items()
        for cell in cells
    ]
    return Experiment(name=NAME, points=tuple(points), x=axis("period_s", "controller.sampling_period_s"))


# Defaults of the common options; the command has a report of its own.
DECLARED = Declaration(build=experiment, options={}, seeds=5)


def step_ms(setup: Setup) -> float:
    """Return the mean processor time of an agent's step in a run, all stages of computation, ms.

    Raises: ValueError: the run ends before the first counted tick.
    """
    times_ms: list[float] = []

    def record(message: Message) -> None:
        if isinstance(message, StepReport) and message.tick >= _WARM_UP:
            times_ms.append(float(message.times_ms[-1]))

    with threadpoolctl.threadpool_limits(1):  # the clock measures this thread only
        control = memory.simulate(setup, record, time.thread_time_ns)
    if not times_ms:
        raise ValueError(f"expected a run of more than {_WARM_UP} ticks, got {control.outcome}: {control.reason}")
    return statistics.fmean(times_ms)


def measure_in_turns(
    reference: Setup,
    candidates: Mapping[Cell, Setup],
    repeats: int,
    notify: Callable[[int], None],
    *,
    measure: Callable[[Setup], float] = step_ms,
) -> dict[Cell, Load]:
    """Measure all candidates once, then all again, so that a slow period of the machine affects all alike.

    The reference is measured immediately before each candidate, so that both of a ratio see the same machine. The
    function notify gets the number of each finished repetition, from 1; measure returns the processor time of an
    agent's step, ms.
    """
    pairs: dict[Cell, list[tuple[float, float]]] = {cell: [] for cell in candidates}
    for repetition in range(1, repeats + 1):
        for cell, candidate in candidates.items():
            pairs[cell].append((measure(reference), measure(candidate)))
        notify(repetition)
    return {
        cell: Load(
            **asdict(cell),
            agents=len(candidates[cell].agents),
            reference_period_s=reference.settings.sampling_period_s,
            step_ms=[own for _, own in found],
            reference_step_ms=[first for first, _ in found],
        )
        for cell, found in pairs.items()
    }


def processor_times(
    folder: Path, settings: Sequence[str], cells: Sequence[Cell], *, quick: bool, notify: Callable[[str], None]
) -> Loads:
    """Return the processor time of every cell, measured once for each folder.

    Raises: ExperimentError: the folder was measured with other settings, or by another version of this package.
    """
    maneuver, repeats = (_QUICK_MEASUREMENT, _QUICK_REPEATS) if quick else (MANEUVER, _REPEATS)
    path, begun_with = folder / _COMPUTATION, [*settings, maneuver]
    if path.exists():
        return _measured(path, begun_with, cells)
    reference = setup_of(CENTRALIZED, begun_with)
    candidates = {cell: setup_of(cell.controller, [*begun_with, *at_rate(cell)]) for cell in cells}

    def finished(repetition: int) -> None:
        notify(f"computation of {len(cells)} controllers and periods: repetition {repetition} of {repeats} done")

    loads = measure_in_turns(reference, candidates, repeats, finished)
    content = {"settings": begun_with, "loads": [asdict(load) for load in loads.values()]}
    write_whole(path, orjson.dumps(content) + b"\n")
    return loads


def _measured(path: Path, settings: Sequence[str], cells: Sequence[Cell]) -> Loads:
    content = orjson.loads(path.read_bytes())
    if content["settings"] != settings:
        raise refused("--set", f"the settings {path.parent} was begun with, {content['settings']}", settings)
    try:
        loads = [Load(**entry) for entry in content["loads"]]
    except TypeError:
        loads = []
    found = {Cell(controller=load.controller, period_s=load.period_s, horizon=load.horizon): load for load in loads}
    if list(found) != list(cells):
        raise refused("--out", "a folder of this version of the experiment", f"{path.parent}, begun with other periods")
    return found


def equal_periods(loads: Sequence[Load], budget: str) -> PeriodRange:
    """Return the range of sampling periods at which a controller computes as much as the reference.

    Args:
        loads: Loads of one controller, from the longest period to the shortest.
        budget: `TEAM` or `AGENT`.
    """
    periods_s = [load.period_s for load in loads]
    repetitions = zip(*(load.ratios(budget) for load in loads), strict=True)
    equal_s = [_crossing_s(periods_s, ratios) for ratios in repetitions]
    return PeriodRange(min(equal_s), max(equal_s))


def _crossing_s(periods_s: Sequence[float], ratios: Sequence[float]) -> float:
    """Return the period at which a ratio of computation is one, s; periods from the longest to the shortest.

    Between two periods the ratio is interpolated as a power of the period: exact for a constant step time, and close
    for a growing horizon. Infinite if the ratio exceeds one even at the longest period; 0 if it stays below one.
    """
    if ratios[0] > 1.0:
        return math.inf
    pairs = itertools.pairwise(zip(periods_s, ratios, strict=True))
    for (longer_s, less), (shorter_s, more) in pairs:
        if more >= 1.0:
            low, high = math.log(less), math.log(more)
            share = -low / (high - low) if high > low else 0.0
            return longer_s * math.pow(shorter_s / longer_s, share)
    return periods_s[-1] if ratios[-1] == 1.0 else 0.0
