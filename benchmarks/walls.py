"""Walls that no agent knows: `python -m benchmarks.walls` flies `precise` at 1.5 m/s towards one, seen 3 m away.

Place, width and heading of each wall, and the direction of the path, are drawn from a seed. In the rows
with silence there is the delay and loss too, and no message passes for 3 s from the tick at which the first
UAV sees the wall.

One line for each row, `--runs` for each run; `--row TEXT` selects rows. `--write` renews each row of the
table in docs/record/guarantees.md as soon as its runs are done.
"""

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from rich.console import Console

from benchmarks.runs import origin
from docs.tables import ROOT, put_rows
from transport.flight.memory import simulate
from transport.flight.progress import compile_models
from transport.model.arrays import Array
from transport.model.physics.obstacles import clearances
from transport.model.state import R0, THETA0, V0
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Measurement, Message, PlantState

SCENARIO = "precise"
MARGIN_M, LOAD_MARGIN_M = 0.4, 0.1
_SIGHT_M = 3.0
_WAY_M, _WAY_MPS = 14.0, 1.5
_REST_S = 18.0  # after the path
_SILENT_S = 3.0
# Ranges of a wall: place along the path and beside it, width and turn from across the path; its other sizes.
_ALONG_M, _BESIDE_M, _WIDTH_M, _TURN_DEG = (6.0, 9.0), (-1.0, 1.0), (1.0, 4.0), (-60.0, 60.0)
_THICK_M, _HIGH_M = 0.2, 8.0
_MIDDLE_Z_M = -10.0
_WALLS = 68  # stream of the draws of walls
_ARRIVED_M = 0.3  # from the end of the path
_REST_MPS = 0.05

_LATE = ("links.delay_s=0.2", "links.loss=0.3")
_STOP = "controller.silence=stop"
_CONFIRMED = "controller.targets=confirmed"
_SILENT = "3 s of silence"  # on top of the delay and loss
# Settings of each row.
ROWS: Mapping[str, tuple[str, ...]] = {
    "perfect network": (),
    "200 ms, 30 % loss": _LATE,
    f"{_SILENT}, eager, no stop": _LATE,
    f"{_SILENT}, eager, stop": (*_LATE, _STOP),
    f"{_SILENT}, confirmed, stop": (*_LATE, _STOP, _CONFIRMED),
}
HEADINGS = (
    "network and rules", "goes round", "rests before the wall", "contacts", "margins kept",
    f"UAVs to the wall, least (margin {MARGIN_M} m)",
    f"rods and payload, least (margin {LOAD_MARGIN_M} m)", "attitude at most", "UAVs apart",
)  # fmt: skip


class _Seen(Exception):  # noqa: N818 - it ends a run, and is no error
    """A UAV sees the wall."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """Ground truth of a run."""

    arrives: bool
    rests: bool
    uav_m: float  # least distance from the wall
    load_m: float
    attitude_deg: float
    apart_m: float

    @property
    def touches(self) -> bool:
        """Whether a body touches the wall."""
        return min(self.uav_m, self.load_m) <= 0.0

    @property
    def keeps_margins(self) -> bool:
        """Whether all bodies keep their margins."""
        return self.uav_m >= MARGIN_M and self.load_m >= LOAD_MARGIN_M


def scene(seed: int) -> tuple[str, ...]:
    """Return the settings of a path with a wall across it, drawn from a seed."""
    # In this order: it decides which wall a seed has.
    rng = np.random.default_rng([seed, _WALLS])
    direction = rng.uniform(0.0, 2.0 * math.pi)
    along_m = rng.uniform(*_ALONG_M)
    beside_m = rng.uniform(*_BESIDE_M)
    width_m = rng.uniform(*_WIDTH_M)
    turn_deg = rng.uniform(*_TURN_DEG)

    # From along and beside the path into the inertial frame.
    c, s = math.cos(direction), math.sin(direction)
    x = c * along_m - s * beside_m
    y = s * along_m + c * beside_m
    heading_deg = turn_deg + math.degrees(direction)
    phases = (
        "{name='hover',duration_s=1.0,displacement_m=[0,0,0]}",
        f"{{name='go',kind='spline',points_m=[[{_WAY_M * c:.3f},{_WAY_M * s:.3f},0]],"
        f"speed_mps={_WAY_MPS},ramp_s=3.0}}",
        f"{{name='after',duration_s={_REST_S},displacement_m=[0,0,0]}}",
    )
    wall = (
        f"{{kind='box',at_m=[{x:.3f},{y:.3f},{_MIDDLE_Z_M}],size_m=[{_THICK_M},{width_m:.3f},{_HIGH_M}],"
        f"heading_deg={heading_deg:.2f},margin_m={MARGIN_M},"
        f"load_margin_m={LOAD_MARGIN_M},seen_within_m={_SIGHT_M}}}"
    )
    return (f"maneuver.phase=[{','.join(phases)}]", f"obstacle=[{wall}]", f"seed={seed}")


def prepared(*settings: str) -> Setup:
    """Return `precise` with settings, its model compiled."""
    path = find_scenario(SCENARIO)
    scenario = read_scenario(path, settings)
    compile_models([scenario], Console(stderr=True))
    return Setup.of(scenario, path.name)


def sight_s(setup: Setup) -> float:
    """Return the instant at which the first UAV sees the wall, s."""
    seen: list[int] = []

    def watch(message: Message) -> None:
        if isinstance(message, Measurement) and len(message.seen):
            seen.append(message.tick)
            raise _Seen

    try:
        simulate(setup, watch)
    except _Seen:
        return setup.settings.sampling_period_s * seen[0]
    raise SystemExit("benchmarks.walls: expected a wall in sight, got none")


def setup_of(row: str, seed: int) -> Setup:
    """Return the run of a row with a wall; the silence begins with the sight in the run without it."""
    settings = (*scene(seed), *ROWS[row])
    setup = prepared(*settings)
    if _SILENT not in row:
        return setup

    start_s = sight_s(setup)
    times = f"start_s={start_s},end_s={start_s + _SILENT_S}"
    others = range(1, len(setup.scenario.owned))
    cuts = [f"{{between=['agent{agent}'],{times}}}" for agent in others]
    return prepared(*settings, f"links.partition=[{','.join(cuts)}]")


def fly(row: str, seed: int) -> Flown:
    """Fly a row with a wall."""
    setup = setup_of(row, seed)
    states: list[PlantState] = []

    def record(message: Message) -> None:
        if isinstance(message, PlantState):
            states.append(message)

    end = simulate(setup, record)
    x = np.array([one.x for one in states])
    N = setup.system.N
    wall_m = clearances(setup.system, setup.obstacles[0], x)
    goal_I = setup.maneuver.path(np.array([setup.maneuver.duration_s]))[0][0]
    is_complete = end.outcome == "completed"
    arrives = is_complete and float(np.linalg.norm(x[-1, R0] - goal_I)) < _ARRIVED_M
    is_still = float(np.linalg.norm(x[-1, V0])) < _REST_MPS
    return Flown(
        arrives=arrives,
        rests=is_complete and is_still and not arrives,
        uav_m=float(wall_m[:, :N].min()),
        load_m=float(wall_m[:, N:].min()),
        attitude_deg=float(np.degrees(np.abs(x[:, THETA0]).max())),
        apart_m=_apart_m(setup, x),
    )


def _apart_m(setup: Setup, x: Array) -> float:
    """Return the least distance between the centres of two UAVs at the states, (K, n), m."""
    N = setup.system.N
    places_I = setup.model.outputs_along(x)[:, : 3 * N].reshape(len(x), N, 3)
    pairs = combinations(range(N), 2)
    return min(
        float(np.linalg.norm(places_I[:, a] - places_I[:, b], axis=1).min()) for a, b in pairs
    )


def cells(flown: Sequence[Flown]) -> list[str]:
    """Return the cells of a row but the first."""
    count = len(flown)
    return [
        f"{sum(one.arrives for one in flown)} of {count}",
        f"{sum(one.rests for one in flown)}",
        f"{sum(one.touches for one in flown)}",
        f"{sum(one.keeps_margins for one in flown)} of {count}",
        f"{min(one.uav_m for one in flown):.2f} m",
        f"{min(one.load_m for one in flown):.2f} m",
        f"{max(one.attitude_deg for one in flown):.1f} deg",
        f"{min(one.apart_m for one in flown):.2f} m",
    ]


def main(given: Sequence[str] | None = None) -> None:
    """Fly the rows and print their lines."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.walls", description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="number of walls")
    parser.add_argument("--first", type=int, default=100, help="seed of the first wall")
    parser.add_argument("--row", default="", help="text in the names of the rows to fly")
    parser.add_argument("--runs", action="store_true", help="print a line for each run")
    parser.add_argument("--write", action="store_true", help="renew the rows of the page")
    options = parser.parse_args(given)
    document = ROOT / "docs" / "record" / "guarantees.md"

    for row in (row for row in ROWS if options.row in row):
        flown = []
        for seed in range(options.first, options.first + options.seeds):
            flown.append(fly(row, seed))
            if options.runs:
                sys.stdout.write(f"  seed {seed}: {', '.join(cells(flown[-1:]))}\n")
                sys.stdout.flush()
        sys.stdout.write(f"{row}: {', '.join(cells(flown))}\n")
        sys.stdout.flush()
        if options.write:
            put_rows(document, "bench: walls", HEADINGS, list(ROWS), {row: cells(flown)}, origin())


if __name__ == "__main__":
    main(sys.argv[1:])
