"""Cost of keys and floods: a run plain, with keys, and flooded, in turns. `python -m benchmarks.network`.

In lockstep as fast as possible, compared by the median over the turns. The flood is a process on the same host with the
keys of agent 1, which repeats agent 1's messages on its own key to all processes; its own work is part of the cost.
"""

import argparse
import json
import socket
import statistics
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.flights import setup
from benchmarks.page import BenchmarkError, Table
from benchmarks.processes import recorded
from deploy.keys import LOOPBACK, OTHERS, make_certificates
from protocol.network.endpoints import process_names
from protocol.scenario.file import ScenarioError
from transport.flight.run import machine

# Smallest speed of a secured run over a plain one, and of a flooded one over a secured one.
KEYS_SHARE, FLOOD_SHARE = 0.75, 0.5
RATE_HZ = 10_000
VARIANTS = {"plain": "", "keys": "", "flood, replayed": "replayed", "flood, renumbered": "renumbered"}


def measure(turns: int, settings: Sequence[str] = ()) -> tuple[Table, list[str]]:
    """Run each variant in turns.

    Args:
        turns: Runs of each.
        settings: Further settings of the scenario.
    Returns: The table, and the variants that miss their aim.
    Raises: BenchmarkError: a run fails, or its cost differs from the others'.
    """
    factors: dict[str, list[float]] = {name: [] for name in VARIANTS}
    costs: set[str] = set()
    with TemporaryDirectory() as temporary:
        keys, names = Path(temporary) / "keys", process_names(setup("paper").scenario)
        make_certificates(keys, dict.fromkeys([*names, *OTHERS], LOOPBACK), days=1)
        for turn in range(turns):
            for number, (name, flood) in enumerate(VARIANTS.items()):
                folder, base = Path(temporary) / f"run-{turn}-{number}", _free_base(len(names))
                secured = [] if name == "plain" else [f"network.keys={keys}"]
                with _flooded(flood, folder.name, keys, [f"tls/127.0.0.1:{base + i}" for i in range(len(names))]):
                    run = recorded(setup("paper", *settings, f"network.base_port={base}", *secured), folder)
                factors[name].append(float(run.summary["real_time_factor"]))
                costs.add(json.dumps(run.summary["cost"]))
                sys.stderr.write(f"{name}: {factors[name][-1]:.2f} x real time\n")
    if len(costs) != 1:
        raise BenchmarkError(f"expected the same flight every time, got costs {sorted(costs)}")
    medians = {name: statistics.median(values) for name, values in factors.items()}
    rows = [
        [name, f"{medians[name]:.2f}", " ".join(f"{value:.2f}" for value in values), f"{share:.2f}"]
        for name, values in factors.items()
        for share in [medians[name] / medians["plain"]]
    ]
    aims = {"keys": KEYS_SHARE * medians["plain"], **dict.fromkeys(list(VARIANTS)[2:], FLOOD_SHARE * medians["keys"])}
    missed = [f"{name}: {medians[name]:.2f}, expected {aim:.2f}" for name, aim in aims.items() if medians[name] < aim]
    columns = ["run", "x real time, median", "each", "of plain"]
    return Table(text=f"`paper` in lockstep, in turns; {machine()}.", columns=columns, rows=rows), missed


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.network", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--turns", type=int, default=5, help="runs of each")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args(arguments)
    try:
        table, missed = measure(options.turns, options.settings)
    except (BenchmarkError, ScenarioError) as error:
        sys.stderr.write(f"network: {error}\n")
        return 1
    sys.stdout.write(f"{table}\n")
    for line in missed:
        sys.stderr.write(f"network: too slow: {line}\n")
    return 1 if missed else 0


@contextmanager
def _flooded(flood: str, run: str, keys: Path, endpoints: Sequence[str]) -> Iterator[None]:
    """Run the flood beside a run; nothing for an empty kind of flood."""
    if not flood:
        yield
        return
    command = [sys.executable, "-m", "tests.support.attack", run, "1", str(RATE_HZ), flood, str(keys), *endpoints]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.kill()


def _free_base(count: int) -> int:
    """Return a base port with as many free ports in a row."""
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
