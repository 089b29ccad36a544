"""The whole loop in wall-clock time: ticks of runs with processes, their floor, start-up, memory, recording."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import processes
from benchmarks.effort import Effort
from benchmarks.page import Table
from benchmarks.runs import messages, setup
from benchmarks.timing import Times, digits, joined, quiet, round_trips
from protocol.wire.codec import encode
from protocol.wire.keys import RECORDER
from protocol.wire.messages import Plan
from transport.flight import memory

# Messages of a tick that wait for each other: tick, measurement, plan. A round trip is two.
_IN_A_ROW = 3

TEAMS = (
    "`resilient` resized to N UAVs, run by `transport run` as fast as possible; wall-clock times in ms. Tick: mean. "
    "Step of an agent, and network (rest of the tick without the slowest step, `rest_of_tick_ms`): median (99th "
    "percentile). Floor: three messages in sequence, as many as depend on each other in a tick, through a pipe between "
    "two processes, {size} bytes each, measured directly before and after the run. Memory: peak of the largest agent "
    "and of the recorder; shared memory is divided among its users."
)
MANEUVER = "The same {seconds:g} s of `paper` with processes and in memory, wall-clock time."
RECORDING = (
    "Cost of recording: `resilient` with and without a recorder, {turns} times in turns; wall-clock time per tick, "
    "from the time when all processes have joined to the end of the plant."
)


def measure(effort: Effort, log: Callable[[str], None]) -> list[Table]:
    """Run with processes."""
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as folder:
        return [table(effort, Path(folder), log) for table in (_teams, _maneuver, _recording)]


def _teams(effort: Effort, folder: Path, log: Callable[[str], None]) -> Table:
    size = len(encode(next(m for m in messages(setup("resilient", effort.climb)) if isinstance(m, Plan))))
    rows: list[tuple[str, ...]] = []
    for uavs in effort.processes:
        log(f"{uavs} UAVs with processes")
        before = round_trips(effort.round_trips, size)
        run = processes.recorded(setup("resilient", effort.process_climb, uavs=uavs), folder / f"team-{uavs}")
        floor = Times(joined([before, round_trips(effort.round_trips, size)]).ms * _IN_A_ROW / 2.0)
        summary, peaks_MB = run.summary, run.memory_MB
        step, rest = summary["agent_step_ms"], summary["rest_of_tick_ms"]
        numbers = (
            rest["p50"] / floor.median,
            summary["real_time_factor"],
            summary["startup_s"],
            max((peak for name, peak in peaks_MB.items() if name.startswith("agent")), default=np.nan),
            peaks_MB.get(RECORDER, np.nan),
        )
        rows.append((str(uavs), digits(run.tick_ms), _spread(step), _spread(rest), str(floor), *map(digits, numbers)))
    columns = (
        "UAVs", "tick, ms", "an agent's step", "network", "floor", "network over floor", "real-time factor",
        "start-up, s", "agent, MB", "recorder, MB",
    )  # fmt: skip
    return Table(text=TEAMS.format(size=size), columns=columns, rows=rows)


def _maneuver(effort: Effort, folder: Path, log: Callable[[str], None]) -> Table:
    run = setup(*effort.maneuver)
    seconds = run.maneuver.duration_s
    log(f"{seconds:g} s of {run.scenario.name}, with processes and in memory")
    wall_s = {"processes": float(processes.recorded(run, folder / "maneuver").summary["wall_time_s"])}
    with quiet():
        start = time.perf_counter()
        memory.simulate(run)
        wall_s["in memory"] = time.perf_counter() - start
    rows = [(name, *map(digits, (taken, 1e3 * taken / run.ticks, seconds / taken))) for name, taken in wall_s.items()]
    columns = ("", "run, s", "tick, ms", "real-time factor")
    return Table(text=MANEUVER.format(seconds=seconds), columns=columns, rows=rows)


def _recording(effort: Effort, folder: Path, log: Callable[[str], None]) -> Table:
    run = setup("resilient", effort.process_climb)
    tick_ms: dict[str, list[float]] = {"with": [], "without": []}
    for turn in range(effort.recordings):
        log(f"with and without a recorder: {turn + 1} of {effort.recordings}")
        for name, simulate in (("with", processes.recorded), ("without", processes.unrecorded)):
            simulate(run, folder / f"{name}-{turn}")
            tick_ms[name].append(1e3 * processes.duration_s(folder / f"{name}-{turn}" / "logs") / run.ticks)
    ratios = [with_ / without for with_, without in zip(tick_ms["with"], tick_ms["without"], strict=True)]
    rows = [
        (name, digits(float(np.median(values))), digits(min(values)), digits(max(values)))
        for name, values in (*((f"{name} a recorder", ms) for name, ms in tick_ms.items()), ("ratio", ratios))
    ]
    text = RECORDING.format(turns=effort.recordings)
    return Table(text=text, columns=("tick, ms", "median", "least", "most"), rows=rows)


def _spread(values: dict[str, float]) -> str:
    return f"{digits(values['p50'])} ({digits(values['p99'])})"
