"""Comparison of centralized and distributed control: the controllers and their grid of sampling periods."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import orjson

from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.setup import Setup
from transport.experiments.cases import Point
from transport.experiments.declaration import Declaration, Experiment
from transport.experiments.errors import refused
from transport.experiments.processor_time import (
    MANEUVER,
    QUICK_MANEUVER,
    QUICK_REPEATS,
    REPEATS,
    Load,
    measure_in_turns,
)
from transport.experiments.quantities import axis
from transport.report.report import write_whole

NAME = "paper"

# The paper publishes no weights: its algorithm is run with ours.
CENTRALIZED, PAPER, CLOSED_LOOP = "centralized", "paper's algorithm", "closed loop"
SCENARIOS = {CENTRALIZED: "centralized", PAPER: "paper", CLOSED_LOOP: "resilient"}
STEPS, SECONDS = "steps", "seconds"
STILL, GUSTS = "still air", "gusts"

# The curves: a controller, and whether its horizon keeps the reference's number of steps or of seconds.
CURVES = ((CENTRALIZED, STEPS), (CENTRALIZED, SECONDS), (PAPER, STEPS), (PAPER, SECONDS), (CLOSED_LOOP, SECONDS))

# Sampling periods over the reference's: 100 to 15 ms for the paper's 50 ms.
GRID = (2.0, 1.5, 1.0, 0.7, 0.5, 0.4, 0.3)
QUICK_GRID = (1.0, 0.5)

# Shortest period of some curves over the reference's: below it an agent computes more than the reference, and the long
# horizons take more time than all other runs together.
_SHORTEST = {(CENTRALIZED, SECONDS): 0.5, (PAPER, SECONDS): 0.4, (CLOSED_LOOP, SECONDS): 0.4}

_COMPUTATION = "computation.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A controller at one sampling period."""

    controller: str
    period_s: float  # T_s
    horizon: int  # N_p, steps


Curves = Mapping[tuple[str, str], Sequence[Cell]]
Loads = Mapping[Cell, Load]


def curves_of(period_s: float, horizon: int, *, quick: bool = False) -> Curves:
    """Return the cells of each curve by controller and kept horizon, from the longest period to the shortest.

    Sampling period, s, and horizon, steps, are those of the reference; quick gives two periods only.
    """
    return {
        (controller, kept): [
            Cell(controller=controller, period_s=own_s, horizon=horizon_of(horizon, period_s, own_s, kept))
            for factor in (QUICK_GRID if quick else GRID)
            if factor >= _SHORTEST.get((controller, kept), 0.0)
            for own_s in (round(factor * period_s, 6),)
        ]
        for controller, kept in CURVES
    }


def cells_of(curves: Curves) -> list[Cell]:
    """Return every cell once; two curves of a controller meet at the reference's period."""
    return list(dict.fromkeys(cell for cells in curves.values() for cell in cells))


def horizon_of(steps: int, period_s: float, own_period_s: float, kept: str) -> int:
    """Return N_p at another sampling period: as many steps, or steps for as many seconds."""
    return steps if kept == STEPS else max(1, round(steps * period_s / own_period_s))


def setup_of(controller: str, settings: Sequence[str]) -> Setup:
    """Return the run of a controller.

    Raises: ScenarioError: wrong settings.
    """
    path = find_scenario(SCENARIOS[controller])
    return Setup.of(read_scenario(path, settings), str(path))


def reference_of(settings: Sequence[str]) -> Setup:
    """Return the centralized run that all others are compared to.

    Raises: ScenarioError: more than one agent.
    """
    reference = setup_of(CENTRALIZED, settings)
    if len(reference.agents) > 1:
        source = str(find_scenario(SCENARIOS[CENTRALIZED]))
        raise ScenarioError(source, "agents.owned", f"expected one agent that owns all, got {len(reference.agents)}")
    return reference


def at_rate(cell: Cell) -> tuple[str, ...]:
    """Return the settings of a cell's sampling period and horizon, with a plant step of at most one period."""
    rate = f"controller.sampling_period_s={cell.period_s!r}", f"controller.horizon={cell.horizon}"
    return (*rate, *([f"plant.step_s={cell.period_s!r}"] if cell.period_s < 0.01 else []))


def processor_times(
    folder: Path, settings: Sequence[str], cells: Sequence[Cell], *, quick: bool, notify: Callable[[str], None]
) -> Loads:
    """Return the processor time of every cell, measured once for each folder.

    Raises: ExperimentError: the folder was measured with other settings, or by another version of this package.
    """
    maneuver, repeats = (QUICK_MANEUVER, QUICK_REPEATS) if quick else (MANEUVER, REPEATS)
    path, begun_with = folder / _COMPUTATION, [*settings, maneuver]
    if path.exists():
        return _measured(path, begun_with, cells)
    reference = setup_of(CENTRALIZED, begun_with)
    candidates = [(cell.controller, setup_of(cell.controller, [*begun_with, *at_rate(cell)])) for cell in cells]

    def finished(repetition: int) -> None:
        notify(f"computation of {len(cells)} controllers and periods: repetition {repetition} of {repeats} done")

    loads = measure_in_turns(reference, candidates, repeats, finished)
    write_whole(path, orjson.dumps({"settings": begun_with, "loads": [asdict(load) for load in loads]}) + b"\n")
    return dict(zip(cells, loads, strict=True))


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
