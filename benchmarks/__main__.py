"""The command: `make bench`, or `python -m benchmarks --help`."""

import argparse
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from benchmarks import aims, loop, parts, solvers, step, structured
from benchmarks.effort import FULL, QUICK, Effort
from benchmarks.page import BenchmarkError, Table, check, write
from protocol.wire.exit_codes import EXIT_INTERRUPTED
from transport.flight.run import machine

ROOT = Path(__file__).resolve().parent.parent
DOCUMENT = ROOT / "docs" / "performance.md"

SECTIONS: Mapping[str, Callable[[Effort, Callable[[str], None]], list[Table]]] = {
    "aims": aims.measure,
    "step": step.measure,
    "solvers": solvers.measure,
    "structured": structured.measure,
    "parts": parts.measure,
    "loop": loop.measure,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, then write; nothing is written before everything is measured.

    Returns: Exit code.
    """
    asked = _options().parse_args(arguments)
    names = asked.only or list(SECTIONS)
    document: Path | None = asked.document if asked.quick else asked.document or DOCUMENT
    try:
        if document is not None:
            check(document, names)
        sections = {name: _section(name, QUICK if asked.quick else FULL) for name in names}
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
    _say(f"written: {document}")
    return 0


def _section(name: str, effort: Effort) -> str:
    """A section's text: its tables, and on what they were measured."""
    load, start = os.getloadavg()[0], time.monotonic()
    tables = SECTIONS[name](effort, lambda what: _say(f"{name}: {what}"))
    _say(f"{name}: {time.monotonic() - start:.0f} s")
    where = f"{machine()}, Python {platform.python_version()}; {time.strftime('%Y-%m-%d')}; load before: {load:.1f}."
    return "\n\n".join([*map(str, tables), f"*{where}*"])


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def _options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure, and write docs/performance.md.")
    parser.add_argument("--quick", action="store_true", help="little of everything, to standard output")
    parser.add_argument("--only", action="append", choices=list(SECTIONS), help="this section; may be repeated")
    parser.add_argument(
        "--document", type=Path, help="write here; by default docs/performance.md, with --quick nowhere"
    )
    return parser


if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM):  # what has been started is ended, in the background too
        signal.signal(number, signal.default_int_handler)
    sys.exit(main())
