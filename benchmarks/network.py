"""Cost of keys and floods: a run plain, with keys, and flooded."""

import json
import socket
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.effort import Effort
from benchmarks.page import BenchmarkError, Table
from benchmarks.processes import recorded
from benchmarks.runs import setup
from deploy.keys import LOOPBACK, OTHERS, make_certificates
from protocol.network.endpoints import process_names

RATE_HZ = 10_000
VARIANTS = {"plain": "", "keys": "", "keys, flood, replayed": "replayed", "keys, flood, renumbered": "renumbered"}
# Smallest speed of a secured run over a plain one, and of a flooded one over a secured one.
AIMS = {"plain": "", "keys": "at least 0.75 of plain", **dict.fromkeys(list(VARIANTS)[2:], "at least 0.5 of keys")}

TEXT = (
    "`{name}` in lockstep as fast as possible, in turns. The flood is a process on the same host with the keys of "
    "agent 1, which repeats 10,000 messages of agent 1 per second to all processes, unchanged or with new numbers; "
    "its own processor time is part of the cost. All runs have the same cost to the last digit."
)


def measure(effort: Effort, log: Callable[[str], None]) -> list[Table]:
    """Run each variant in turns.

    Raises: BenchmarkError: a run fails, or its cost differs from the others'.
    """
    factors: dict[str, list[float]] = {name: [] for name in VARIANTS}
    costs: set[str] = set()
    with TemporaryDirectory(prefix="benchmarks-") as temporary:
        keys, names = Path(temporary) / "keys", process_names(setup(*effort.maneuver).scenario)
        make_certificates(keys, dict.fromkeys([*names, *OTHERS], LOOPBACK), days=1)
        for turn in range(effort.floods):
            for number, (name, flood) in enumerate(VARIANTS.items()):
                folder, base = Path(temporary) / f"run-{turn}-{number}", _free_base(len(names))
                secured = [] if name == "plain" else [f"network.keys={keys}"]
                with _flooded(flood, folder.name, keys, [f"tls/127.0.0.1:{base + i}" for i in range(len(names))]):
                    run = recorded(setup(*effort.maneuver, f"network.base_port={base}", *secured), folder)
                factors[name].append(float(run.summary["real_time_factor"]))
                costs.add(json.dumps(run.summary["cost"]))
                log(f"{name}: {factors[name][-1]:.2f} x real time")
    if len(costs) != 1:
        raise BenchmarkError(f"expected the same cost every time, got {sorted(costs)}")
    medians = {name: statistics.median(values) for name, values in factors.items()}
    rows = [
        (name, f"{medians[name]:.2f}", ", ".join(f"{value:.2f}" for value in values), f"{share:.2f}", AIMS[name])
        for name, values in factors.items()
        for share in [medians[name] / medians["plain"]]
    ]
    columns = ("run", "x real time, median", "each", "of plain", "aim")
    return [Table(text=TEXT.format(name=effort.maneuver[0]), columns=columns, rows=rows)]


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
