"""Runs with processes, and the memory that they use."""

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import tomli_w

from benchmarks.page import BenchmarkError
from protocol.scenario.setup import Setup
from protocol.wire.keys import RECORDER

# Time allowed besides the simulated time: sixteen agents need half a minute to start on two busy cores.
_PATIENCE_S = 600.0
_LEAVE_S = 20.0
_LOOK_EVERY_S = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Summary of a recorded run, mean wall-clock time of a tick, and peak memory by process (shared by its share)."""

    summary: dict[str, Any]
    tick_ms: float
    memory_MB: dict[str, float]


def recorded(setup: Setup, folder: Path) -> Run:
    """Run a scenario by `transport run` into a new folder.

    Raises: BenchmarkError: the command fails or does not end.
    """
    scenario = folder.parent / f"{folder.name}.toml"
    scenario.write_text(tomli_w.dumps(setup.scenario.tree()), encoding="utf-8")
    command = [sys.executable, "-m", "transport", "run", str(scenario), "--out", str(folder), "--no-figures"]
    memory_MB: dict[str, float] = {}
    with (folder.parent / f"{folder.name}.err").open("w+", encoding="utf-8") as errors:
        # In a session of its own, so that Ctrl-C reaches this process only, which ends the run in order.
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True) as run:
            try:
                patience_s = _PATIENCE_S + setup.maneuver.duration_s
                deadline = time.monotonic() + patience_s
                while run.poll() is None:
                    if time.monotonic() > deadline:
                        raise BenchmarkError(f"{' '.join(command)}: expected to end in {patience_s:g} s, it did not")
                    for name, pid in processes_of(run.pid).items():
                        memory_MB[name] = max(_memory_MB(pid), memory_MB.get(name, 0.0))
                    time.sleep(_LOOK_EVERY_S)
            finally:
                _end(run)
        if run.returncode != 0:
            errors.seek(0)
            lines = errors.read().strip().splitlines() or [""]
            raise BenchmarkError(f"{' '.join(command)}: exit code {run.returncode}: {lines[-1]}")
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return Run(summary=summary, tick_ms=1e3 * float(summary["wall_time_s"]) / setup.ticks, memory_MB=memory_MB)


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


def _memory_MB(pid: str) -> float:
    """Return the memory of a process, shared memory by its share; 0 if it has ended."""
    try:
        shares = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8")
    except OSError:
        return 0.0
    return sum(float(line.split()[1]) for line in shares.splitlines() if line.startswith("Pss:")) * 1024 / 1e6


def _end(run: subprocess.Popen[bytes]) -> None:
    if run.poll() is None:
        run.terminate()
        try:
            run.wait(_LEAVE_S)
        except subprocess.TimeoutExpired:
            run.kill()
