"""The whole loop in wall-clock time: ticks of runs with processes, the floor beneath, start-up, memory, recording."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import processes
from benchmarks.effort import Effort
from benchmarks.flights import messages, setup
from benchmarks.page import Table
from benchmarks.pipe import round_trips
from benchmarks.timing import Times, digits, quiet
from protocol.wire.codec import encode
from protocol.wire.messages import Plan
from transport.flight import memory

# Messages of a tick that wait for each other: tick, measurement, plan. A round trip is two.
_IN_A_ROW = 3

TEAMS = (
    "`resilient` made into teams of N, flown with `transport run` as fast as it goes; wall-clock times in ms. A tick: "
    "mean. An agent's step, and all of a tick but the slowest step (`network_ms`): median (99th percentile). Floor: "
    "three messages one after the other, as many as wait for each other in a tick, over a bare pipe between two "
    "processes, {size} bytes each, right before and after. Memory: peaks of the largest agent and of the "
    "recorder; of what processes share, each has its share."
)
MANEUVER = "The same {seconds:g} s of `paper` with processes and in memory, wall-clock time."
RECORDING = (
    "What recording costs: `resilient` with and without a recorder, {turns} times in turns; wall-clock time of a tick "
    "from the coordinator's having met all to the plant's end."
)


def measure(effort: Effort, say: Callable[[str], None]) -> list[Table]:
    """Fly with processes."""
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as folder:
        return [
            _teams(effort, Path(folder), say),
            _maneuver(effort, Path(folder), say),
            _recording(effort, Path(folder), say),
        ]


def _teams(effort: Effort, folder: Path, say: Callable[[str], None]) -> Table:
    run = setup("resilient", effort.climb)
    size = len(encode(next(message for message in messages(run) if isinstance(message, Plan))))
    rows: list[tuple[str, ...]] = []
    for uavs in effort.processes:
        say(f"{uavs} UAVs with processes")
        team = setup("resilient", effort.flown, uavs=uavs)
        before = round_trips(effort.round_trips, size)
        flown = processes.recorded(team, folder / f"team-{uavs}")
        after = round_trips(effort.round_trips, size)
        floor = Times(np.concatenate([before.ms, after.ms]) * _IN_A_ROW / 2.0)
        summary = flown.summary
        memory_MB = {name: peak for name, peak in flown.memory_MB.items() if name.startswith("agent")}
        rows.append(
            (
                str(uavs),
                digits(flown.tick_ms),
                _spread(summary["agent_step_ms"]),
                _spread(summary["rest_of_tick_ms"]),
                str(floor),
                digits(float(summary["rest_of_tick_ms"]["p50"]) / floor.median),
                digits(float(summary["real_time_factor"])),
                digits(float(summary["startup_s"])),
                digits(max(memory_MB.values(), default=np.nan)),
                digits(flown.memory_MB.get("recorder", np.nan)),
            )
        )
    columns = (
        "UAVs", "tick, ms", "an agent's step", "network", "floor", "network over floor", "real-time factor",
        "start-up, s", "agent, MB", "recorder, MB",
    )  # fmt: skip
    return Table(text=TEAMS.format(size=size), columns=columns, rows=rows)


def _maneuver(effort: Effort, folder: Path, say: Callable[[str], None]) -> Table:
    run = setup(*effort.maneuver)
    say(f"{run.maneuver.duration_s:g} s of {run.scenario.name}, with processes and in memory")
    flown = processes.recorded(run, folder / "maneuver")
    with quiet():
        start = time.perf_counter()
        memory.simulate(run)
        in_memory_s = time.perf_counter() - start
    rows = [
        (name, digits(wall_s), digits(1e3 * wall_s / run.ticks), digits(run.maneuver.duration_s / wall_s))
        for name, wall_s in (("processes", float(flown.summary["wall_time_s"])), ("in memory", in_memory_s))
    ]
    return Table(
        text=MANEUVER.format(seconds=run.maneuver.duration_s),
        columns=("", "flight, s", "tick, ms", "real-time factor"),
        rows=rows,
    )


def _recording(effort: Effort, folder: Path, say: Callable[[str], None]) -> Table:
    run = setup("resilient", effort.flown)
    tick_ms: dict[str, list[float]] = {"with": [], "without": []}
    for turn in range(effort.recordings):
        say(f"with and without a recorder: {turn + 1} of {effort.recordings}")
        for name, simulate in (("with", processes.recorded), ("without", processes.unrecorded)):
            at = folder / f"{name}-{turn}"
            simulate(run, at)
            tick_ms[name].append(1e3 * processes.duration_s(at / "logs") / run.ticks)
    rows: list[tuple[str, ...]] = [
        (f"{name} a recorder", digits(float(np.median(ms))), digits(min(ms)), digits(max(ms)))
        for name, ms in tick_ms.items()
    ]
    ratios = [with_ / without for with_, without in zip(tick_ms["with"], tick_ms["without"], strict=True)]
    rows.append(("ratio", *(digits(float(value)) for value in (np.median(ratios), min(ratios), max(ratios)))))
    return Table(
        text=RECORDING.format(turns=effort.recordings), columns=("tick, ms", "median", "least", "most"), rows=rows
    )


def _spread(values: dict[str, float]) -> str:
    return f"{digits(values['p50'])} ({digits(values['p99'])})"
