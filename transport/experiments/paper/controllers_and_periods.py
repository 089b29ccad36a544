"""Comparison of centralized and distributed control: the controllers at each sampling period, and their runs."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from transport.experiments.cases import Point
from transport.experiments.declaration import QUICK_MANEUVER, Experiment

NAME = "paper"

# The paper publishes no weights: its algorithm is run with ours.
CENTRALIZED = "centralized"
PAPER = "paper's algorithm"
CLOSED_LOOP = "closed loop"
SCENARIOS = {CENTRALIZED: "centralized", PAPER: "paper", CLOSED_LOOP: "paper"}
# The controller of `resilient` with the weights of the others: costs under different weights do not
# compare.
_CLOSED_LOOP = (
    "controller.prediction=closed_loop",
    "controller.linearisation=along",
    "controller.terminal=riccati",
    "controller.preview=true",
    "controller.received_plans=by_age",
    "controller.relaxation=0.5",
)
# Length of the horizon that a curve keeps.
STEPS = "steps"
SECONDS = "seconds"
# Weathers.
STILL = "still air"
GUSTS = "gusts"

# The curves: a controller, and whether its horizon keeps the reference's number of steps or of
# seconds; with the shortest period over the reference's. Below it an agent computes more than the
# reference, and the long horizons take more time than all other runs together. The first is the
# reference's own: verdicts and figure read the reference from it.
CURVES = {
    (CENTRALIZED, STEPS): 0.0,
    (CENTRALIZED, SECONDS): 0.5,
    (PAPER, SECONDS): 0.4,
    (PAPER, STEPS): 0.0,
    (CLOSED_LOOP, SECONDS): 0.4,
}

# Sampling periods over the reference's, falling: 100 to 15 ms for the paper's 50 ms. Both grids
# have the reference itself, 1.0.
GRID = (2.0, 1.5, 1.0, 0.7, 0.5, 0.4, 0.3)
QUICK_GRID = (1.0, 0.5)

# Budgets of computation: of the whole team and of one agent.
TEAM = "the whole team"
AGENT = "one agent"

# Maneuver and repetitions of the measurement: long enough to settle, short enough that a repetition
# sees one machine.
MANEUVER = QUICK_MANEUVER
QUICK_MEASUREMENT = "maneuver.phase=[{name='climb',duration_s=0.4,displacement_m=[0,0,-0.2]}]"
REPEATS = 5
QUICK_REPEATS = 1

Row = dict[str, Any]

# Defaults of the common options; the command has a report and scenarios of its own.
DECLARED = Experiment(name=NAME, seeds=5, scenarios=())


class Cell(NamedTuple):
    """A controller at one sampling period."""

    controller: str
    period_s: float  # T_s
    horizon: int  # N_p, steps


def cells_of(reference: Cell, *, quick: bool = False) -> dict[tuple[str, str], list[Cell]]:
    """Return the cells by controller and kept horizon, from the longest period to the shortest.

    Quick gives two.
    """
    grid = QUICK_GRID if quick else GRID

    def cell(controller: str, kept: str, factor: float) -> Cell:
        horizon = reference.horizon if kept == STEPS else max(1, round(reference.horizon / factor))
        return Cell(controller, round(factor * reference.period_s, 6), horizon)

    return {
        curve: [cell(*curve, factor) for factor in grid if factor >= shortest]
        for curve, shortest in CURVES.items()
    }


def experiment(cells: Sequence[Cell], gust_mps: float) -> Experiment:
    """Return the sweep: every cell in still air and in gusts.

    There are no gusts if their standard deviation, m/s, is zero.
    """
    weathers = {STILL: 0.0}
    if gust_mps:
        weathers[GUSTS] = gust_mps
    points = [_point(cell, weather, gust) for weather, gust in weathers.items() for cell in cells]
    return replace(DECLARED, points=tuple(points))


def _point(cell: Cell, weather: str, gust_mps: float) -> Point:
    """Return a cell in a weather as a point of the sweep."""
    settings = (
        *(_CLOSED_LOOP if cell.controller == CLOSED_LOOP else ()),
        f"controller.sampling_period_s={cell.period_s!r}",
        f"controller.horizon={cell.horizon}",
        f"plant.wind.gust_mps=[{gust_mps!r},{gust_mps!r},{gust_mps!r}]",
    )
    text = f"{1e3 * cell.period_s:g} ms x {cell.horizon}, {weather}"
    labels = {"weather": weather, **cell._asdict()}
    return Point(labels, text, settings, scenario=SCENARIOS[cell.controller])
