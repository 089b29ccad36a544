"""Runs with processes: started as people start them, watched for their memory."""

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from benchmarks.page import BenchmarkError
from protocol.network.health import command_of
from protocol.network.process import mesh, process_names
from protocol.scenario.setup import Setup
from transport.flight.harness import Harness, free_ports

# A run may take so long besides what it flies: sixteen agents need half a minute to start on two busy cores.
_PATIENCE_S = 600.0
_LEAVE_S = 20.0
_LOOK_EVERY_S = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """What a recorded run came to.

    Attributes:
        summary: Its summary.json.
        tick_ms: Wall-clock time of a tick, mean.
        memory_MB: Most memory by process, of what several share its share; the recorder's process under "recorder".
    """

    summary: dict[str, Any]
    tick_ms: float
    memory_MB: dict[str, float]


def recorded(setup: Setup, folder: Path) -> Run:
    """Fly with `transport run`.

    Args:
        setup: The run.
        folder: Run folder to create.
    Raises: BenchmarkError: the command fails or does not end.
    """
    scenario = _written(setup, folder)
    command = [sys.executable, "-m", "transport", "run", str(scenario), "--out", str(folder), "--no-figures"]
    memory_MB: dict[str, float] = {}
    with (folder.parent / f"{folder.name}.err").open("w+", encoding="utf-8") as errors:
        # A session of its own: Ctrl-C reaches this process, which ends the run in order.
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True) as run:
            try:
                patience_s = _PATIENCE_S + setup.maneuver.duration_s
                deadline = time.monotonic() + patience_s
                while run.poll() is None:
                    if time.monotonic() > deadline:
                        raise BenchmarkError(f"{' '.join(command)}: expected to end in {patience_s:g} s, it did not")
                    for name, share in _memory_MB(run.pid).items():
                        memory_MB[name] = max(share, memory_MB.get(name, 0.0))
                    time.sleep(_LOOK_EVERY_S)
            finally:
                if run.poll() is None:
                    _end(run)
        if run.returncode != 0:
            errors.seek(0)
            said = errors.read().strip().splitlines() or [""]
            raise BenchmarkError(f"{' '.join(command)}: exit code {run.returncode}: {said[-1]}")
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return Run(summary=summary, tick_ms=1e3 * float(summary["wall_time_s"]) / setup.ticks, memory_MB=memory_MB)


def duration_s(logs: Path) -> float:
    """Wall-clock time of a flight as its processes' logs have it: the coordinator has seen all, the plant is done.

    Raises: BenchmarkError: the logs do not say so.
    """
    times = {
        (name, entry.get("event")): float(entry["time"])
        for name in ("coordinator", "plant")
        for entry in map(json.loads, (logs / f"{name}.log").read_text(encoding="utf-8").splitlines())
    }
    try:
        return times["plant", "finished"] - times["coordinator", "joined"]
    except KeyError as error:
        raise BenchmarkError(f"{logs}: expected a run from joined to finished, got no {error}") from error


def unrecorded(setup: Setup, folder: Path) -> None:
    """Fly with the processes of a run and nobody to record it; its logs are in `folder / "logs"`.

    Raises: BenchmarkError: a process fails or does not end.
    """
    scenario = _written(setup, folder)
    names, host = process_names(setup.scenario), setup.scenario.network.host
    with (
        free_ports(host, len(names)) as ports,
        Harness(setup.scenario.name, scenario, mesh(names, host, ports), folder / "logs") as harness,
    ):
        harness.start()
        if not harness.wait(_PATIENCE_S):
            raise BenchmarkError(f"{folder}: expected the processes to end in {_PATIENCE_S:g} s, they did not")
        for child in harness.children:
            if child.process.returncode != 0:
                raise BenchmarkError(f"{child.name}: exit code {child.process.returncode}: {child.last_words()}")


def _written(setup: Setup, folder: Path) -> Path:
    """The scenario as a file beside the run folder."""
    path = folder.parent / f"{folder.name}.toml"
    path.write_text(tomli_w.dumps(setup.scenario.tree()), encoding="utf-8")
    return path


def _end(run: subprocess.Popen[bytes]) -> None:
    run.terminate()
    try:
        run.wait(_LEAVE_S)
    except subprocess.TimeoutExpired:
        run.kill()


def _memory_MB(parent: int) -> dict[str, float]:
    """Memory of a run's processes by name, of what several share its share; nothing where the system does not tell."""
    found = {}
    try:
        children = Path(f"/proc/{parent}/task/{parent}/children").read_text(encoding="utf-8").split()
    except OSError:
        return {}
    for pid in [str(parent), *children]:
        try:
            shares = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8")
        except OSError:
            continue  # it has ended
        share = [line.split()[1] for line in shares.splitlines() if line.startswith("Pss:")]
        words = command_of(pid)
        if share and "transport" in words:
            found[_name(words)] = float(share[0]) * 1024 / 1e6
    return found


def _name(words: Sequence[str]) -> str:
    """Which process a command line is."""
    role = words[words.index("transport") + 1]
    return "recorder" if role == "run" else f"agent{words[words.index('--id') + 1]}" if role == "agent" else role
