"""The whole loop in wall-clock time: ticks of runs with processes, start-up, memory."""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil
import tomli_w

from benchmarks.runs import BenchmarkError, setup
from benchmarks.timing import digits
from docs.tables import table
from protocol.scenario.setup import Setup

TEXT = (
    "`resilient` resized to N UAVs, run by `transport run` as fast as possible; wall-clock times in ms. Tick: mean. "
    "Step of an agent, and network (rest of the tick without the slowest step, `rest_of_tick_ms`): median (99th "
    "percentile). Memory: peak of the largest agent; shared memory is divided among its users."
)
CLIMB = "maneuver.phase=[{name='climb',duration_s=5.0,displacement_m=[0.5,0,-1.0]}]"
COLUMNS = ("UAVs", "tick, ms", "an agent's step", "network", "real-time factor", "start-up, s", "agent, MB")


def measure() -> str:
    """Run teams with processes, and return the table.

    Raises: BenchmarkError: a run fails.
    """
    rows = []
    for uavs in (4, 8, 16):
        run = setup("resilient", CLIMB, uavs=uavs)
        with tempfile.TemporaryDirectory(prefix="benchmarks-") as folder:
            summary, memory_MB = recorded(run, Path(folder) / "run")
        spreads = [summary[name] for name in ("agent_step_ms", "rest_of_tick_ms")]
        cells = [f"{digits(values['p50'])} ({digits(values['p99'])})" for values in spreads]
        numbers = (summary["real_time_factor"], summary["startup_s"], memory_MB)
        rows.append([str(uavs), digits(1e3 * summary["wall_time_s"] / run.ticks), *cells, *map(digits, numbers)])
    return f"{TEXT}\n\n{table(COLUMNS, rows)}"


def recorded(run: Setup, folder: Path) -> tuple[dict[str, Any], float]:
    """Run a scenario by `transport run` into a new folder; return its summary and the peak memory of an agent, MB.

    Raises: BenchmarkError: the command fails.
    """
    scenario = folder.with_suffix(".toml")
    scenario.write_text(tomli_w.dumps(run.scenario.tree()), encoding="utf-8")
    command = [sys.executable, "-m", "transport", "run", str(scenario), "--out", str(folder), "--no-figures"]
    most_MB = 0.0
    # In a session of its own, so that Ctrl-C reaches this process only, which ends the run in order.
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True) as running:
        try:
            while running.poll() is None:
                most_MB = max(most_MB, memory_of(running.pid))
                time.sleep(0.2)
        finally:
            running.terminate()
    if running.returncode != 0:
        raise BenchmarkError(f"{' '.join(command)}: exit code {running.returncode}")
    return json.loads((folder / "summary.json").read_text(encoding="utf-8")), most_MB


def memory_of(pid: int) -> float:
    """Return the memory of the largest agent below a process, MB; 0 if one has just ended."""
    try:
        agents = [each for each in psutil.Process(pid).children() if "transport agent" in " ".join(each.cmdline())]
        return max((1e-6 * agent.memory_full_info().pss for agent in agents), default=0.0)
    except psutil.Error:
        return 0.0
