"""Renew the measured table of docs/realtime.md: `python docs/realtime_page.py`, eight minutes on an idle machine.

Runs `resilient` in real time beside endless loops, which this script starts and ends. Rows whose settings this user
may not use, such as scheduling classes without root, say so.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tables import ROOT, commit, put, table

from transport.flight.header import machine

DOCUMENT = ROOT / "docs" / "realtime.md"
COMMAND = ("run", "resilient", "--set", "clock.mode=realtime", "--set", "clock.speed=1")


@dataclass(frozen=True, slots=True)
class Row:
    """Runs of one row."""

    loops: int  # endless loops beside them
    core: int | None = None  # of the loops; None for all cores
    before: Sequence[str] = ()  # command in front of `transport`
    settings: Sequence[str] = ()
    runs: int = 1

    @property
    def name(self) -> str:
        """The row's first cell."""
        where = f"{self.loops} loops" if self.loops else "idle"
        where += "" if self.core is None else f" on core {self.core}"
        words = [*self.settings, *([" ".join(self.before) + " transport ..."] if self.before else [])]
        return ", ".join([where, *(f"`{word}`" for word in words)])


MANY = 32
ROWS = (
    Row(0, runs=3),
    Row(8, runs=3),
    Row(MANY, runs=3),
    Row(MANY, settings=("clock.on_overrun=hold",), runs=2),
    Row(MANY, settings=("clock.on_overrun=abort", "clock.overrun_limit=20")),
    Row(MANY, before=("nice", "-n", "-10"), runs=2),
    Row(MANY, core=0, before=("taskset", "-c", "1")),
    Row(MANY, before=("chrt", "-f", "10"), runs=3),
)


@contextmanager
def load(loops: int, core: int | None) -> Iterator[None]:
    """Keep processors busy by endless loops, each in a session of its own."""
    where = [] if core is None else ["taskset", "-c", str(core)]
    command = [*where, sys.executable, "-c", "while True: pass"]
    started = [subprocess.Popen(command, start_new_session=True) for _ in range(loops)]
    try:
        yield
    finally:
        for loop in started:
            loop.kill()
            loop.wait()


def simulate(row: Row, folder: Path) -> dict[str, Any] | None:
    """Return the summary of one run; None if this user may not put the command in front of it."""
    if row.before:
        if shutil.which(row.before[0]) is None:
            return None
        tried = subprocess.run([*row.before, "true"], capture_output=True, check=False)
        if tried.returncode != 0 or tried.stderr:  # nice goes on without the priority
            return None
    command = [*row.before, sys.executable, "-P", "-m", "transport", *COMMAND, "--no-figures", "--format", "json"]
    settings = [part for setting in row.settings for part in ("--set", setting)]
    command += [*settings, "--out", str(folder)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=ROOT, check=False)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def cells(row: Row, runs: Sequence[dict[str, Any]]) -> list[str]:
    """Return the cells of a row; the times are those of its first run."""
    if not runs:
        return [row.name, "not permitted here", "", "", "", ""]
    missed = "; ".join(f"{run['deadline']['missed']} of {run['deadline']['plans']}" for run in runs)
    late, step = runs[0]["deadline"]["tick_late_ms"], runs[0]["agent_step_ms"]
    ends = [f"{count} x {end}" if count > 1 else end for end, count in Counter(map(ended, runs)).items()]
    took = "; ".join(f"{run['wall_time_s']:.1f}" for run in runs)
    return [row.name, missed, times(late), times(step), "; ".join(ends), took]


def times(found: dict[str, float]) -> str:
    """Return median, 99th percentile and maximum, ms."""
    return ", ".join(f"{float(f'{found[name]:.2g}'):g}" for name in ("p50", "p99", "max"))


def ended(run: dict[str, Any]) -> str:
    """Return the end of a run in words."""
    if run["outcome"] == "completed":
        return f"completed, cost {1e3 * run['cost']['mean']:.2f}e-3"
    return f"{run['outcome']} at {run['sim_time_s']:.2f} s"


def main() -> None:
    """Measure all rows and write the table."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="realtime-") as folder:
        for number, row in enumerate(ROWS):
            with load(row.loops, row.core):
                places = [Path(folder) / f"{number}-{i}" for i in range(row.runs)]
                runs = [run for run in (simulate(row, place) for place in places) if run is not None]
            sys.stderr.write(f"{row.name}: {'; '.join(map(ended, runs)) or 'not permitted'}\n")
            rows.append(cells(row, runs))
    headings = ["", "plans that missed", "ticks late, ms", "agent step, ms", "end of the run", "duration, s"]
    put(DOCUMENT, "measured", f"{table(headings, rows)}\n\n*Commit {commit()}. {machine()}.*")


if __name__ == "__main__":
    main()
