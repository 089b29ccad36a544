"""Two versions of the project on one machine, in turns: the folder of another one against this one.

Each has to be installed in its own .venv. AVX2 is what a compiler makes that knows no AVX-512: `CC` is a
script that switches it off for both, which is a processor of another kind for all that follows.

    git worktree add ../before COMMIT; make -C ../before .venv/.installed
    python -m benchmarks.against ../before --turns 3
"""

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from benchmarks.runs import digits, origin
from benchmarks.start import instants
from docs.tables import ROOT, table

# Processor time of a run in memory, s: the least of some, after one that fills the caches.
IN_MEMORY = """
import gc, sys, time
from rich.console import Console
from transport.cli.options import read_setup
from transport.flight.memory import simulate
from transport.flight.progress import compile_models

setup = read_setup(sys.argv[1], allow_large=True)
compile_models([setup.scenario], Console(stderr=True))
setup = read_setup(sys.argv[1], ["seed=0"], allow_large=True)  # with the compiled model
simulate(setup)
times = []
for _ in range(int(sys.argv[2])):
    gc.collect()
    gc.disable()
    begun_s = time.process_time()
    simulate(setup)
    times.append(time.process_time() - begun_s)
print(min(times))
"""
BUDGET = 24  # cases of a search
REAL_TIME = (
    "clock.mode=realtime", "clock.speed=1", "controller.sampling_period_s=0.01",
    "maneuver.phase=[{name='climb',duration_s=5.0,displacement_m=[0.5,0,-1.0]}]",
)  # fmt: skip


# A measurement of one version: its folder and environment in, the values of its quantities out.
Measurement = Callable[[Path, Mapping[str, str]], dict[str, float]]


def command(tree: Path, *arguments: str) -> list[str]:
    """Return the command that runs `transport` of a version."""
    return [python_of(tree), "-P", "-m", "transport", *arguments]


def python_of(tree: Path) -> str:
    """Return the interpreter of a version."""
    return str(tree / ".venv" / "bin" / "python")


def in_memory(name: str, uavs: int = 0, runs: int = 4) -> Measurement:
    """Return the measurement of the processor time of one run of a scenario in memory.

    Args:
        name: The ready scenario.
        uavs: Size of the team in place of the scenario's; 0 for the scenario's.
        runs: Number of runs, of which the fastest counts.
    """

    def measured(tree: Path, environment: Mapping[str, str]) -> dict[str, float]:
        with tempfile.TemporaryDirectory(prefix="against-") as parent:
            scenario = name
            if uavs:
                scenario = f"{parent}/team.toml"
                size = ["--uavs", str(uavs), "--from", name, "--out", scenario]
                subprocess.run(
                    command(tree, "scenario", "new", *size),
                    check=True, capture_output=True, env=environment,
                )  # fmt: skip
            arguments = [python_of(tree), "-P", "-c", IN_MEMORY, scenario, str(runs)]
            done = subprocess.run(
                arguments, check=True, capture_output=True, env=environment, text=True
            )
        size_text = f", N = {uavs}" if uavs else ""
        return {
            f"`{name}`{size_text} in memory, s of processor time": float(done.stdout.split()[-1])
        }

    return measured


def with_processes(tree: Path, environment: Mapping[str, str]) -> dict[str, float]:
    """Return processor time of `transport run paper`, and its times before and after the ticks."""
    with tempfile.TemporaryDirectory(prefix="against-") as parent:
        folder = Path(parent) / "run"
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        at_s = instants(command(tree, "run", "paper"), folder, environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        "`transport run paper`, s of processor time": used_s,
        "command to first tick, s": at_s["first tick"],
        "last tick to prompt, s": at_s["prompt"] - at_s["last tick"],
    }


def search(tree: Path, environment: Mapping[str, str]) -> dict[str, float]:
    """Return the time of a search, the inverse of its runs per minute."""
    with tempfile.TemporaryDirectory(prefix="against-") as parent:
        begun_s = time.monotonic()
        subprocess.run(
            command(tree, "worst", "resilient", "--budget", str(BUDGET), "--out", f"{parent}/found"),
            check=True, capture_output=True, env=environment,
        )  # fmt: skip
        return {f"`transport worst resilient`, s for {BUDGET} cases": time.monotonic() - begun_s}


def real_time(tree: Path, environment: Mapping[str, str]) -> dict[str, float]:
    """Return the share of deadlines missed at 100 Hz in real time, and the median step."""
    with tempfile.TemporaryDirectory(prefix="against-") as parent:
        folder = Path(parent) / "run"
        settings = [word for setting in REAL_TIME for word in ("--set", setting)]
        subprocess.run(
            command(tree, "run", "resilient", "--out", str(folder), "--no-figures", *settings),
            check=False,  # a run that misses deadlines may have diverged: its summary counts them too
            capture_output=True, env=environment,
        )  # fmt: skip
        summary = json.loads((folder / "summary.json").read_bytes())
    share = summary["deadline"]["missed"] / max(
        1, summary["ticks"] * len(summary["controller"]["owned"])
    )
    return {
        "deadlines missed at 100 Hz, %": 100.0 * share,
        "step at 100 Hz, ms": summary["agent_step_ms"]["p50"],
    }


PARTS: Mapping[str, Measurement] = {
    "paper": in_memory("paper"),
    "resilient": in_memory("resilient"),
    "sixteen": in_memory("resilient", uavs=16, runs=1),
    "processes": with_processes,
    "search": search,
    "realtime": real_time,
}


def environments(folder: Path, cpuinfo: Path = Path("/proc/cpuinfo")) -> dict[str, dict[str, str]]:
    """Return the environment for each kind of processor that this one can be, by its name."""
    own = {**os.environ}
    for name in ("PAYLOAD_TRANSPORT_NATIVE", "PYTHONDONTWRITEBYTECODE"):
        own.pop(name, None)
    try:
        has_avx512 = "avx512f" in cpuinfo.read_text(encoding="utf-8")
    except OSError:
        has_avx512 = False
    if not has_avx512:
        return {platform.machine(): own}

    compiler = folder / "cc"
    compiler.write_text('#!/bin/sh\nexec cc "$@" -mno-avx512f\n', encoding="utf-8")
    compiler.chmod(0o700)
    return {"AVX-512": own, "AVX2": {**own, "CC": str(compiler)}}


def in_turns(
    measured: Measurement, versions: Mapping[str, tuple[Path, Mapping[str, str]]], turns: int
) -> dict[str, dict[str, list[float]]]:
    """Return the values of each quantity by version, one for each turn.

    Args:
        measured: The measurement of one version.
        versions: Folder and environment of each version, by its name.
        turns: Number of turns that count. One before them compiles the models, and is left out.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for turn in range(turns + 1):
        for version, (tree, environment) in versions.items():
            for quantity, value in measured(tree, environment).items():
                if turn > 0:
                    values = found.setdefault(quantity, {name: [] for name in versions})
                    values[version].append(value)
    return found


def main() -> int:
    """Measure both versions in turns, and print medians and ratios; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.against", description=__doc__)
    parser.add_argument("before", type=Path, help="folder of the other version, with its .venv")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--only", action="append", choices=list(PARTS))
    parser.add_argument(
        "--processor",
        help="AVX-512, AVX2, or the machine's kind without AVX-512; default: all it has",
    )
    options = parser.parse_args()
    trees = {"before": options.before.resolve(), "now": ROOT}

    rows = []
    with tempfile.TemporaryDirectory(prefix="against-") as parent:
        kinds = environments(Path(parent))
        if options.processor not in (None, *kinds):
            parser.error(
                f"--processor: this machine has {' and '.join(kinds)}, not {options.processor}"
            )
        for processor in [options.processor] if options.processor else kinds:
            versions = versions_of(trees, kinds[processor], Path(parent) / processor)
            for part in options.only or PARTS:
                for quantity, values in in_turns(PARTS[part], versions, options.turns).items():
                    rows.append([processor, *cells(quantity, values)])
                    sys.stderr.write(f"{' | '.join(rows[-1])}\n")
    headings = ["processor", f"median of {options.turns} turns", "before", "now", "now / before"]
    sys.stdout.write(f"{table(headings, rows)}\n\n*{origin()}.*\n")
    return 0


def versions_of(
    trees: Mapping[str, Path], environment: Mapping[str, str], caches: Path
) -> dict[str, tuple[Path, Mapping[str, str]]]:
    """Return folder and environment of each version by name: each has a cache of compiled models of its own."""
    return {
        version: (tree, {**environment, "PAYLOAD_TRANSPORT_CACHE": str(caches / version)})
        for version, tree in trees.items()
    }


def cells(quantity: str, values: Mapping[str, Sequence[float]]) -> list[str]:
    """Return the cells of a quantity: the median of each version, and their ratio, empty where it has none."""
    before = statistics.median(values["before"])
    now = statistics.median(values["now"])
    return [quantity, digits(before), digits(now), digits(now / before) if before else ""]


if __name__ == "__main__":
    sys.exit(main())
