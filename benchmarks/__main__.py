"""The command: `make bench`, or `python -m benchmarks --help`."""

import argparse
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from benchmarks import loop, parts, solvers, step
from benchmarks.effort import FULL, QUICK, Effort
from benchmarks.page import BenchmarkError, Table, check, write
from protocol.wire.exit_codes import EXIT_INTERRUPTED
from transport.flight.header import machine

DOCUMENT = Path(__file__).resolve().parent.parent / "docs" / "performance.md"

SECTIONS: Mapping[str, Callable[[Effort, Callable[[str], None]], list[Table]]] = {
    "step": step.measure,
    "solvers": solvers.measure,
    "parts": parts.measure,
    "loop": loop.measure,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all sections, then write them; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure, and write docs/performance.md.")
    parser.add_argument("--quick", action="store_true", help="small sizes, to standard output")
    parser.add_argument("--only", action="append", choices=list(SECTIONS), help="this section; may be repeated")
    parser.add_argument("--document", type=Path, help="file to write (docs/performance.md; none with --quick)")
    options = parser.parse_args(arguments)
    names = options.only or list(SECTIONS)
    document: Path | None = options.document if options.quick else options.document or DOCUMENT
    try:
        if document is not None:
            check(document, names)
        sections = {name: _section(name, QUICK if options.quick else FULL) for name in names}
        if document is None:
            sys.stdout.write("\n\n".join(sections.values()) + "\n")
            return 0
        write(document, sections)
    except BenchmarkError as error:
        sys.stderr.write(f"benchmarks: {error}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("\nbenchmarks: interrupted, nothing is written\n")
        return EXIT_INTERRUPTED
    _log(f"written: {document}")
    return 0


def _section(name: str, effort: Effort) -> str:
    """Return a section's text: its tables, machine and date."""
    load, start = os.getloadavg()[0], time.monotonic()
    tables = SECTIONS[name](effort, lambda text: _log(f"{name}: {text}"))
    _log(f"{name}: {time.monotonic() - start:.0f} s")
    where = f"{machine()}, Python {platform.python_version()}; {time.strftime('%Y-%m-%d')}; load before: {load:.1f}."
    return "\n\n".join([*map(str, tables), f"*{where}*"])


def _log(text: str) -> None:
    print(text, file=sys.stderr, flush=True)  # noqa: T201


if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM):  # end started processes, also when in the background
        signal.signal(number, signal.default_int_handler)
    sys.exit(main())
