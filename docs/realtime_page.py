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
from pathlib import Path
from typing import Any, NamedTuple

from tables import ROOT, commit, put, table

from transport.flight.header import machine

DOCUMENT = ROOT / "docs" / "realtime.md"
COMMAND = ("run", "resilient", "--set", "clock.mode=realtime", "--set", "clock.speed=1")


class Row(NamedTuple):
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


def cells(runs: Sequence[dict[str, Any]]) -> list[str]:
    """Return the cells of a row; the times are those of its first run."""
    if not runs:
        return ["not permitted here", "", "", "", ""]
    late, step = (
        ", ".join(f"{float(f'{found[name]:.2g}'):g}" for name in ("p50", "p99", "max"))
        for found in (runs[0]["deadline"]["tick_late_ms"], runs[0]["agent_step_ms"])
    )
    return [
        "; ".join(f"{run['deadline']['missed']} of {run['deadline']['plans']}" for run in runs),
        late,
        step,
        "; ".join(f"{count} x {end}" if count > 1 else end for end, count in Counter(map(ended, runs)).items()),
        "; ".join(f"{run['wall_time_s']:.1f}" for run in runs),
    ]


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
                found = (simulate(row, Path(folder) / f"{number}-{i}") for i in range(row.runs))
                runs = [run for run in found if run is not None]
            rows.append([row.name, *cells(runs)])
            sys.stderr.write(f"{', '.join(rows[-1])}\n")
    headings = ["", "plans that missed", "ticks late, ms", "agent step, ms", "end of the run", "duration, s"]
    put(DOCUMENT, "measured", f"{table(headings, rows)}\n\n*Commit {commit()}. {machine()}.*")


if __name__ == "__main__":
    main()
