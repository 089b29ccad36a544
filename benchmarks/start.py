"""Times of `transport run` before its first tick and after its last, from the files of its run folder."""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from docs.tables import table
from transport.log.run_log import read_log
from transport.protocol.wire.messages import Control, Tick

RUNS = 5
TEXT = (
    f"`transport run paper`, wall-clock times, ms, medians of {RUNS} runs: from the command to the first tick, and "
    "from the last tick to the prompt. The instants are those of files and of lines in the logs of the processes."
)
# Each ends at the instant of its name in `instants`.
PHASES = {
    "read": "interpreter and imports, scenario read and checked",
    "listening": "fork server forked, its imports, processes forked; their sessions open",
    "first tick": "all joined",
    "last tick": "",
    "recorded": "log closed, processes ended",
    "summary": "log read, summary written",
    "prompt": "table of steps and figures written, summary printed",
}


def instants(
    command: Sequence[str], folder: Path, environment: Mapping[str, str]
) -> dict[str, float]:
    """Run a command that records into a folder, and return the ends of its phases, s after its begin."""
    begun_s = time.time()
    subprocess.run(
        [*command, "--out", str(folder)], check=True, capture_output=True, env=environment
    )
    ended_s = time.time()

    events = [
        json.loads(line)
        for log in folder.glob("logs/*.log")
        for line in log.read_text(encoding="utf-8").splitlines()
        if line.startswith("{")
    ]
    log = read_log(folder / "run.mcap", horizons=False)
    found_s = {
        "read": (folder / "scenario.toml").stat().st_mtime,
        "listening": max(event["time"] for event in events if event["event"] == "listening"),
        "first tick": min(log.received_ns(Tick).values()) / 1e9,
        "last tick": min(log.received_ns(Control).values()) / 1e9,
        "recorded": (folder / "run.mcap").stat().st_mtime,
        "summary": (folder / "summary.json").stat().st_mtime,
        "prompt": ended_s,
    }
    return {name: at_s - begun_s for name, at_s in found_s.items()}


def measure() -> str:
    """Return the table of the phases."""
    command = [sys.executable, "-P", "-m", "transport", "run", "paper"]
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as parent:
        runs = [instants(command, Path(parent) / str(run), {**os.environ}) for run in range(RUNS)]

    rows = []
    names = list(PHASES)
    for before, name in zip([None, *names], names, strict=False):
        if PHASES[name]:
            times_s = [run[name] - (0.0 if before is None else run[before]) for run in runs]
            rows.append([PHASES[name], f"{1e3 * statistics.median(times_s):.0f}"])
    starts_s = [run["first tick"] for run in runs]
    ends_s = [run["prompt"] - run["last tick"] for run in runs]
    rows.append(["command to first tick", f"{1e3 * statistics.median(starts_s):.0f}"])
    rows.append(["last tick to prompt", f"{1e3 * statistics.median(ends_s):.0f}"])
    return f"{TEXT}\n\n{table(['', 'ms'], rows)}"
