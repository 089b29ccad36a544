"""The command: `make bench`, or `python -m benchmarks --help`."""

import argparse
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping

from benchmarks import loop, parts, solvers, step
from benchmarks.runs import BenchmarkError
from benchmarks.timing import origin
from docs.tables import ROOT, place, put

DOCUMENT = ROOT / "docs" / "performance.md"

# Functions that return the sections' texts, with a table each.
SECTIONS: Mapping[str, Callable[[], str]] = {
    "step": step.measure,
    "solvers": solvers.measure,
    "parts": parts.measure,
    "loop": loop.measure,
}


def main() -> int:
    """Measure the sections and write each; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure, and write docs/performance.md.")
    parser.add_argument("--only", action="append", choices=list(SECTIONS), help="this section; may be repeated")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends started processes
    for name in parser.parse_args().only or SECTIONS:
        place(DOCUMENT, f"bench: {name}")  # refused before minutes are spent
        load, start = os.getloadavg()[0], time.monotonic()
        try:
            text = SECTIONS[name]()
        except BenchmarkError as error:
            sys.stderr.write(f"benchmarks: {error}\n")
            return 1
        put(DOCUMENT, f"bench: {name}", f"{text}\n\n*{origin()}; load before: {load:.1f}.*")
        sys.stderr.write(f"{name}: {time.monotonic() - start:.0f} s\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
