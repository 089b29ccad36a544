"""What keys and floods cost: the same flight plain, with keys, and flooded, in turns. `python -m benchmarks.network`.

In lockstep as fast as it goes. Every round flies each of them once, so that what else the host does hits all alike;
what counts is the median over the rounds. The flood is a session with the keys of agent 1 that repeats what agent 1
has said, on its own key, to everybody, and is a process on the same host: what it takes itself is in the cost.
"""

import argparse
import json
import socket
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.page import BenchmarkError, Table
from deploy.keys import LOOPBACK, OTHERS, make_certificates
from protocol.network.endpoints import process_names
from protocol.scenario.file import find_scenario, read_scenario
from transport.flight.run import machine

# A secured run may cost a quarter of the plain one's pace, a flood half of it.
KEYS_SHARE, FLOOD_SHARE = 0.75, 0.5
RATE_HZ = 10_000
SORTS = {"plain": "", "keys": "", "flood, replayed": "replayed", "flood, renumbered": "renumbered"}


def measure(rounds: int, say: Sequence[str] = ()) -> tuple[Table, list[str]]:
    """Fly in turns.

    Args:
        rounds: How often each.
        say: Further settings of the scenario.
    Returns: The table, and what missed its aim.
    Raises: BenchmarkError: a run fails, or does not give the same flight.
    """
    factors: dict[str, list[float]] = {name: [] for name in SORTS}
    costs: set[str] = set()
    with TemporaryDirectory() as folder:
        keys = Path(folder) / "keys"
        names = process_names(read_scenario(find_scenario("paper")))
        make_certificates(keys, dict.fromkeys([*names, *OTHERS], LOOPBACK), days=1)
        for number in range(rounds):
            for name in SORTS:
                summary = _fly(Path(folder) / f"{name.replace(', ', '-')}-{number}", name, keys, len(names), say)
                factors[name].append(float(summary["real_time_factor"]))
                costs.add(json.dumps(summary["cost"]))
                sys.stderr.write(f"{name}: {factors[name][-1]:.2f} x real time\n")
    if len(costs) != 1:
        raise BenchmarkError(f"expected the same flight every time, got costs {sorted(costs)}")
    medians = {name: statistics.median(values) for name, values in factors.items()}
    rows = [
        [name, f"{medians[name]:.2f}", " ".join(f"{value:.2f}" for value in factors[name]), f"{share:.2f}"]
        for name, share in ((name, medians[name] / medians["plain"]) for name in SORTS)
    ]
    aims = {"keys": KEYS_SHARE * medians["plain"], **dict.fromkeys(list(SORTS)[2:], FLOOD_SHARE * medians["keys"])}
    missed = [f"{name}: {medians[name]:.2f}, expected {aim:.2f}" for name, aim in aims.items() if medians[name] < aim]
    columns = ["run", "x real time, median", "each", "of plain"]
    return Table(text=f"`paper` in lockstep, in turns; {machine()}.", columns=columns, rows=rows), missed


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.network", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    asked = parser.parse_args(arguments)
    try:
        table, missed = measure(asked.rounds, asked.settings)
    except BenchmarkError as error:
        sys.stderr.write(f"network: {error}\n")
        return 1
    sys.stdout.write(f"{table}\n")
    for line in missed:
        sys.stderr.write(f"network: slower than it should be: {line}\n")
    return 1 if missed else 0


def _fly(folder: Path, name: str, keys: Path, count: int, settings: Sequence[str]) -> dict[str, Any]:
    base = _free_base(count)
    changes = [*settings, f"network.base_port={base}", *([] if name == "plain" else [f"network.keys={keys}"])]
    words = [
        sys.executable,
        "-m",
        "transport",
        "run",
        "paper",
        "--out",
        str(folder),
        "--no-figures",
        "--format",
        "json",
    ]
    words += [part for setting in changes for part in ("--set", setting)]
    flood: subprocess.Popen[bytes] | None = None
    if SORTS[name]:
        at = [f"tls/127.0.0.1:{base + i}" for i in range(count)]
        own = [folder.name, "1", str(RATE_HZ), SORTS[name], str(keys), *at]
        flood = subprocess.Popen([sys.executable, "-m", "tests.support.attack", *own], stdout=subprocess.PIPE)
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    finally:
        if flood is not None:
            flood.kill()
            flood.wait()
    if done.returncode != 0:
        raise BenchmarkError(
            f"{name}: transport run: expected exit code 0, got {done.returncode}: {done.stderr[-500:]}"
        )
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


def _free_base(count: int) -> int:
    """A base port with room for a run above it, where nobody listens."""
    for base in range(21_000, 29_000, count + 1):
        try:
            for i in range(count):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", base + i))
        except OSError:
            continue
        return base
    raise BenchmarkError("no free ports")


if __name__ == "__main__":
    sys.exit(main())
