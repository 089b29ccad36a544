"""Shares of the processor time of a run: native code, NumPy, the interpreter, messages.

Samples of `perf` (Debian: linux-perf) by the library in which they fall; processes by fork included.
"""

import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from benchmarks.runs import BenchmarkError, digits
from docs.tables import table

FREQUENCY_HZ = 1999
NATIVE, NUMPY, INTERPRETER, MESSAGES = "native", "NumPy", "interpreter", "messages"
# By the beginning of a library's name; the first that fits counts.
LIBRARIES = {
    "kernels-": NATIVE,
    "model-": NATIVE,
    "libm.": NATIVE,
    "libcasadi": NATIVE,
    "_casadi": NATIVE,
    "daqp": NATIVE,
    "_multiarray_umath": NUMPY,
    "libscipy_openblas": NUMPY,
    "libopenblas": NUMPY,
    "zenoh": MESSAGES,
    "_core": MESSAGES,  # of msgspec
    "[kernel": MESSAGES,  # sockets, wake-ups and memory
    "[vdso]": MESSAGES,
}
IN_MEMORY = """
import sys
from transport.flight.memory import simulate
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup

path = find_scenario(sys.argv[1])
setup = Setup.of(read_scenario(path), path.name)
for _ in range(int(sys.argv[2])):
    simulate(setup)
"""
TEXT = (
    "Shares of processor time by the library in which `perf` finds it, %. Native: model, kernels and solver. NumPy: "
    "with its BLAS. Interpreter: Python itself. Messages: Zenoh, encoding, and the kernel, which sends and wakes up. "
    "In memory: ten runs less one, without start and imports; with processes: all of `transport run --no-figures`."
)


def sampled(command: Sequence[str], folder: Path) -> Counter[str]:
    """Return the samples of a command by what its libraries are for.

    Raises: BenchmarkError: `perf` is missing, or may not sample.
    """
    perf = shutil.which("perf")
    if perf is None:
        raise BenchmarkError("expected `perf` in the path (Debian: linux-perf)")
    data = folder / "perf.data"
    record = [perf, "record", "-q", "-F", str(FREQUENCY_HZ), "-o", str(data), "--", *command]
    report = [perf, "report", "-q", "-i", str(data), "--sort", "dso", "-n", "--stdio"]
    try:
        subprocess.run(record, check=True, capture_output=True)
        lines = subprocess.run(report, check=True, capture_output=True, text=True).stdout
    except subprocess.CalledProcessError as error:
        raise BenchmarkError(f"perf: {error.stderr!s:.200}") from error

    samples = Counter[str]()
    for count, library in re.findall(r"^\s*[\d.]+%\s+(\d+)\s+(\S+)", lines, flags=re.MULTILINE):
        purposes = [to for start, to in LIBRARIES.items() if library.startswith(start)]
        samples[purposes[0] if purposes else INTERPRETER] += int(count)
    return samples


def measure() -> str:
    """Return the table of shares."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as parent:
        folder = Path(parent)
        for name in ("paper", "resilient"):
            in_memory = [sys.executable, "-c", IN_MEMORY, name]
            once = sampled([*in_memory, "1"], folder)
            often = sampled([*in_memory, "10"], folder)
            often.subtract(once)
            rows.append([f"`{name}` in memory", *shares(often)])

            run = [sys.executable, "-m", "transport", "run", name, "--no-figures", "--out"]
            rows.append(
                [f"`{name}`, processes", *shares(sampled([*run, str(folder / name)], folder))]
            )
    return f"{TEXT}\n\n{table(['', NATIVE, NUMPY, INTERPRETER, MESSAGES], rows)}"


def shares(samples: Counter[str]) -> list[str]:
    """Return the shares in the order of the columns, %."""
    whole = sum(samples.values())
    return [
        digits(100.0 * samples[purpose] / whole)
        for purpose in (NATIVE, NUMPY, INTERPRETER, MESSAGES)
    ]
