"""The command: `make bench`, or `python -m benchmarks --help`.

A function for each table of docs/record/performance.md.
"""

import argparse
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping

from benchmarks import shares, solvers, start, step_and_tick_times
from benchmarks.runs import BenchmarkError, origin
from docs.tables import ROOT, place, put

DOCUMENT = ROOT / "docs" / "record" / "performance.md"

SECTIONS: Mapping[str, Callable[[], str]] = {
    "step": step_and_tick_times.step,
    "widths": step_and_tick_times.widths,
    "shares": shares.measure,
    "start": start.measure,
    "solvers": solvers.measure,
    "parts": step_and_tick_times.parts,
    "loop": step_and_tick_times.loop,
}


def main() -> int:
    """Measure the sections and write each; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description="Measure, and write docs/record/performance.md."
    )
    parser.add_argument(
        "--only", action="append", choices=list(SECTIONS), help="this section; may be repeated"
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends started processes
    for name in parser.parse_args().only or SECTIONS:
        place(DOCUMENT, f"bench: {name}")  # refused before minutes are spent
        load, begun_s = os.getloadavg()[0], time.monotonic()
        try:
            text = SECTIONS[name]()
        except BenchmarkError as error:
            sys.stderr.write(f"benchmarks: {error}\n")
            return 1
        put(DOCUMENT, f"bench: {name}", f"{text}\n\n*{origin()}; load before: {load:.1f}.*")
        sys.stderr.write(f"{name}: {time.monotonic() - begun_s:.0f} s\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
