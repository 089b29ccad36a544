"""The whole loop in wall-clock time: ticks of runs with processes, start-up, memory, and the cost of certificates."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.effort import Effort
from benchmarks.page import BenchmarkError, Table
from benchmarks.processes import recorded
from benchmarks.runs import setup
from benchmarks.timing import digits, quiet
from deploy.keys import LOOPBACK, OTHERS, make_certificates
from protocol.network.endpoints import process_names
from protocol.wire.keys import RECORDER
from transport.flight import memory

TEAMS = (
    "`resilient` resized to N UAVs, run by `transport run` as fast as possible; wall-clock times in ms. Tick: mean. "
    "Step of an agent, and network (rest of the tick without the slowest step, `rest_of_tick_ms`): median (99th "
    "percentile). Memory: peak of the largest agent and of the recorder; shared memory is divided among its users."
)
MANEUVER = "The same {seconds:g} s of `paper` with processes and in memory, wall-clock time."
KEYS = "`{name}` without and with certificates (`network.keys`), in turns, with the same cost to the last digit."


def measure(effort: Effort, log: Callable[[str], None]) -> list[Table]:
    """Run with processes.

    Raises: BenchmarkError: a run fails, or its cost depends on certificates.
    """
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as folder:
        return [table(effort, Path(folder), log) for table in (_teams, _maneuver, _keys)]


def _teams(effort: Effort, folder: Path, log: Callable[[str], None]) -> Table:
    rows: list[tuple[str, ...]] = []
    for uavs in effort.processes:
        log(f"{uavs} UAVs with processes")
        run = recorded(setup("resilient", effort.process_climb, uavs=uavs), folder / f"team-{uavs}")
        summary, peaks_MB = run.summary, run.memory_MB
        spreads = [summary[name] for name in ("agent_step_ms", "rest_of_tick_ms")]
        numbers = (
            summary["real_time_factor"],
            summary["startup_s"],
            max((peak for name, peak in peaks_MB.items() if name.startswith("agent")), default=np.nan),
            peaks_MB.get(RECORDER, np.nan),
        )
        cells = [f"{digits(values['p50'])} ({digits(values['p99'])})" for values in spreads]
        rows.append((str(uavs), digits(run.tick_ms), *cells, *map(digits, numbers)))
    columns = (
        "UAVs", "tick, ms", "an agent's step", "network", "real-time factor", "start-up, s", "agent, MB",
        "recorder, MB",
    )  # fmt: skip
    return Table(text=TEAMS, columns=columns, rows=rows)


def _maneuver(effort: Effort, folder: Path, log: Callable[[str], None]) -> Table:
    run = setup(*effort.maneuver)
    seconds = run.maneuver.duration_s
    log(f"{seconds:g} s of {run.scenario.name}, with processes and in memory")
    wall_s = {"processes": float(recorded(run, folder / "maneuver").summary["wall_time_s"])}
    with quiet():
        start = time.perf_counter()
        memory.simulate(run)
        wall_s["in memory"] = time.perf_counter() - start
    rows = [(name, *map(digits, (taken, 1e3 * taken / run.ticks, seconds / taken))) for name, taken in wall_s.items()]
    columns = ("", "run, s", "tick, ms", "real-time factor")
    return Table(text=MANEUVER.format(seconds=seconds), columns=columns, rows=rows)


def _keys(effort: Effort, folder: Path, log: Callable[[str], None]) -> Table:
    keys = folder / "keys"
    names = [*process_names(setup(*effort.maneuver).scenario), *OTHERS]
    make_certificates(keys, dict.fromkeys(names, LOOPBACK), days=1)
    factors: dict[str, list[float]] = {"without": [], "with": []}
    costs = set()
    for turn in range(effort.turns):
        log(f"without and with certificates: {turn + 1} of {effort.turns}")
        for name, settings in (("without", []), ("with", [f"network.keys={keys}"])):
            run = recorded(setup(*effort.maneuver, *settings), folder / f"{name}-{turn}")
            factors[name].append(float(run.summary["real_time_factor"]))
            costs.add(str(run.summary["cost"]))
    if len(costs) != 1:
        raise BenchmarkError(f"expected the same cost every time, got {sorted(costs)}")
    rows = [
        (f"{name} certificates", *(digits(value) for value in (float(np.median(own)), min(own), max(own))))
        for name, own in factors.items()
    ]
    text = KEYS.format(name=effort.maneuver[0])
    return Table(text=text, columns=("real-time factor", "median", "least", "most"), rows=rows)
