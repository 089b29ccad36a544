"""The command: `make bench`, or `python -m benchmarks --help`."""

import argparse
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping

from benchmarks import loop, parts, solvers, step
from benchmarks.effort import FULL, QUICK, Effort
from benchmarks.page import BenchmarkError, origin
from docs.tables import ROOT, place, put
from protocol.wire.exit_codes import EXIT_INTERRUPTED

DOCUMENT = ROOT / "docs" / "performance.md"

# Functions that return the sections' texts, with a table each.
SECTIONS: Mapping[str, Callable[[Effort, Callable[[str], None]], list[str]]] = {
    "step": step.measure,
    "solvers": solvers.measure,
    "parts": parts.measure,
    "loop": loop.measure,
}


def main() -> int:
    """Measure all sections, then write them; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure, and write docs/performance.md.")
    parser.add_argument("--quick", action="store_true", help="small sizes, to standard output")
    parser.add_argument("--only", action="append", choices=list(SECTIONS), help="this section; may be repeated")
    options = parser.parse_args()
    names = options.only or list(SECTIONS)
    for name in names:
        place(DOCUMENT, f"bench: {name}")  # refused before minutes are spent
    try:
        sections = {name: _section(name, QUICK if options.quick else FULL) for name in names}
    except BenchmarkError as error:
        sys.stderr.write(f"benchmarks: {error}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("\nbenchmarks: interrupted, nothing is written\n")
        return EXIT_INTERRUPTED
    if options.quick:
        sys.stdout.write("\n\n".join(sections.values()) + "\n")
        return 0
    for name, content in sections.items():
        put(DOCUMENT, f"bench: {name}", content)
    _log(f"written: {DOCUMENT}")
    return 0


def _section(name: str, effort: Effort) -> str:
    """Return a section's text: its tables, machine and date."""
    load, start = os.getloadavg()[0], time.monotonic()
    tables = SECTIONS[name](effort, lambda text: _log(f"{name}: {text}"))
    _log(f"{name}: {time.monotonic() - start:.0f} s")
    return "\n\n".join([*tables, f"*{origin()}; load before: {load:.1f}.*"])


def _log(text: str) -> None:
    print(text, file=sys.stderr, flush=True)  # noqa: T201


if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM):  # end started processes, also when in the background
        signal.signal(number, signal.default_int_handler)
    sys.exit(main())
