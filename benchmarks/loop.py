"""The whole loop in wall-clock time: ticks of runs with processes, start-up, memory, and the cost of certificates."""

import contextlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import tomli_w

from benchmarks.effort import Effort
from benchmarks.page import BenchmarkError, section
from benchmarks.runs import setup
from benchmarks.timing import digits, quiet
from deploy.keys import LOOPBACK, OTHERS, make_certificates
from protocol.network.endpoints import process_names
from protocol.scenario.setup import Setup
from protocol.wire.keys import RECORDER
from transport.flight import memory

_LOOK_EVERY_S = 0.2


def recorded(setup: Setup, folder: Path) -> tuple[dict[str, Any], dict[str, float]]:
    """Run a scenario by `transport run` into a new folder; return its summary and peak memory by process, MB.

    Raises: BenchmarkError: the command fails.
    """
    scenario = folder.parent / f"{folder.name}.toml"
    scenario.write_text(tomli_w.dumps(setup.scenario.tree()), encoding="utf-8")
    command = [sys.executable, "-m", "transport", "run", str(scenario), "--out", str(folder), "--no-figures"]
    memory_MB: dict[str, float] = {}
    with (folder.parent / f"{folder.name}.err").open("w+", encoding="utf-8") as errors:
        # In a session of its own, so that Ctrl-C reaches this process only, which ends the run in order.
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True) as run:
            try:
                while run.poll() is None:
                    for name, pid in processes_of(run.pid).items():
                        with contextlib.suppress(psutil.Error):  # it has ended
                            used_MB = psutil.Process(int(pid)).memory_full_info().pss / 1e6
                            memory_MB[name] = max(used_MB, memory_MB.get(name, 0.0))
                    time.sleep(_LOOK_EVERY_S)
            finally:
                run.terminate()
        if run.returncode != 0:
            errors.seek(0)
            lines = errors.read().strip().splitlines() or [""]
            raise BenchmarkError(f"{' '.join(command)}: exit code {run.returncode}: {lines[-1]}")
    return json.loads((folder / "summary.json").read_text(encoding="utf-8")), memory_MB


def processes_of(run: int) -> dict[str, str]:
    """Return the process ids of `transport run` and its children by process name; none if it has ended."""
    try:
        parent = psutil.Process(run)
        lines = {process.pid: " ".join(process.cmdline()).split() for process in (parent, *parent.children())}
    except psutil.Error:
        return {}
    found = {}
    for pid, line in lines.items():
        if "transport" in line:
            role = line[line.index("transport") + 1]
            name = RECORDER if role == "run" else f"agent{line[line.index('--id') + 1]}" if role == "agent" else role
            found[name] = str(pid)
    return found


TEAMS = (
    "`resilient` resized to N UAVs, run by `transport run` as fast as possible; wall-clock times in ms. Tick: mean. "
    "Step of an agent, and network (rest of the tick without the slowest step, `rest_of_tick_ms`): median (99th "
    "percentile). Memory: peak of the largest agent and of the recorder; shared memory is divided among its users."
)
MANEUVER = "The same {seconds:g} s of `paper` with processes and in memory, wall-clock time."
KEYS = "`{name}` without and with certificates (`network.keys`), in turns, with the same cost to the last digit."


def measure(effort: Effort, log: Callable[[str], None]) -> list[str]:
    """Run with processes.

    Raises: BenchmarkError: a run fails, or its cost depends on certificates.
    """
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as folder:
        return [part(effort, Path(folder), log) for part in (_teams, _maneuver, _keys)]


def _teams(effort: Effort, folder: Path, log: Callable[[str], None]) -> str:
    rows = []
    for uavs in effort.processes:
        log(f"{uavs} UAVs with processes")
        run = setup("resilient", effort.process_climb, uavs=uavs)
        summary, peaks_MB = recorded(run, folder / f"team-{uavs}")
        spreads = [summary[name] for name in ("agent_step_ms", "rest_of_tick_ms")]
        numbers = (
            summary["real_time_factor"],
            summary["startup_s"],
            max((peak for name, peak in peaks_MB.items() if name.startswith("agent")), default=np.nan),
            peaks_MB.get(RECORDER, np.nan),
        )
        cells = [f"{digits(values['p50'])} ({digits(values['p99'])})" for values in spreads]
        rows.append([str(uavs), digits(1e3 * summary["wall_time_s"] / run.ticks), *cells, *map(digits, numbers)])
    columns = ["UAVs", "tick, ms", "an agent's step", "network", "real-time factor", "start-up, s", "agent, MB"]
    return section(TEAMS, [*columns, "recorder, MB"], rows)


def _maneuver(effort: Effort, folder: Path, log: Callable[[str], None]) -> str:
    run = setup(*effort.maneuver)
    seconds = run.maneuver.duration_s
    log(f"{seconds:g} s of {run.scenario.name}, with processes and in memory")
    wall_s = {"processes": recorded(run, folder / "maneuver")[0]["wall_time_s"]}
    with quiet():
        start = time.perf_counter()
        memory.simulate(run)
        wall_s["in memory"] = time.perf_counter() - start
    rows = [(name, *map(digits, (taken, 1e3 * taken / run.ticks, seconds / taken))) for name, taken in wall_s.items()]
    return section(MANEUVER.format(seconds=seconds), ("", "run, s", "tick, ms", "real-time factor"), rows)


def _keys(effort: Effort, folder: Path, log: Callable[[str], None]) -> str:
    keys = folder / "keys"
    names = [*process_names(setup(*effort.maneuver).scenario), *OTHERS]
    make_certificates(keys, dict.fromkeys(names, LOOPBACK), days=1)
    factors: dict[str, list[float]] = {"without": [], "with": []}
    costs = set()
    for turn in range(effort.turns):
        log(f"without and with certificates: {turn + 1} of {effort.turns}")
        for name, settings in (("without", []), ("with", [f"network.keys={keys}"])):
            summary, _ = recorded(setup(*effort.maneuver, *settings), folder / f"{name}-{turn}")
            factors[name].append(summary["real_time_factor"])
            costs.add(str(summary["cost"]))
    if len(costs) != 1:
        raise BenchmarkError(f"expected the same cost every time, got {sorted(costs)}")
    rows = [
        (f"{name} certificates", *map(digits, (float(np.median(own)), min(own), max(own))))
        for name, own in factors.items()
    ]
    return section(KEYS.format(name=effort.maneuver[0]), ("real-time factor", "median", "least", "most"), rows)
