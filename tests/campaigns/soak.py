"""Soak test: a long run in real time whose resources must not grow.

`python -m tests.campaigns.soak --minutes 30`.

The team hovers in real time while the resources of each process are sampled. The medians of the
first and the last third are compared, after a first tenth in which caches fill. Exit code 0 only if
memory is flat, and threads and open files stay the same. The summary of the run tells the deadlines
missed.

Memory is anonymous memory only: the system decides how much of a mapped file is resident.
"""

import argparse
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil

from benchmarks.runs import BenchmarkError
from tests.support.commands import processes_of
from transport.flight import active_runs

# Share of the time left out, in which caches fill.
_WARM_UP = 0.1

# Largest growth of the median memory over two thirds of the time, by the larger of both:
# fluctuation of an allocator.
GROWTH, GROWTH_BYTES = 0.02, 2 * 1024**2

# Change in threads; those of an idle pool come and go.
THREADS = 2

_PATIENCE_S = 60.0
_STANDSTILL_S = 3.0
_OUTPUT = "output.log"


@dataclass(slots=True)
class Record:
    """Resources of a process over time.

    Attributes:
        memory: Bytes.
        threads: Number of threads.
        files: Number of open files.
    """

    memory: list[float] = field(default_factory=list)
    threads: list[float] = field(default_factory=list)
    files: list[float] = field(default_factory=list)


def soak(
    minutes: float, every_s: float, settings: Sequence[str], folder: Path
) -> dict[str, Record]:
    """Run in real time and sample the resources.

    Args:
        minutes: Duration.
        every_s: Interval of the samples, s.
        settings: Further settings of the scenario.
        folder: Run folder to create.
    Returns: Resources by process name.
    Raises: BenchmarkError: the run does not begin, or is not completed.
    """
    hover = f"maneuver.phase=[{{name='hover',duration_s={60.0 * minutes},displacement_m=[0.0,0.0,0.0]}}]"
    chosen = ["clock.mode=realtime", "clock.speed=1", hover, *settings]
    command = [
        sys.executable,
        "-m",
        "transport",
        "run",
        "resilient",
        "--out",
        str(folder),
        "--no-figures",
    ]
    command += [part for setting in chosen for part in ("--set", setting)]
    with (folder.parent / _OUTPUT).open("wb") as output:
        run = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
    try:
        records = _sampled(run, folder, every_s)
        code = run.wait(_PATIENCE_S + 60.0 * minutes)  # including the report
    finally:
        run.terminate()
        run.wait()
    if code != 0:
        raise BenchmarkError(
            f"transport run: expected exit code 0, got {code}: {_last_line(folder)}"
        )
    return records


def judge(
    records: Mapping[str, Record], growth_bytes: float = GROWTH_BYTES
) -> tuple[list[str], list[str]]:
    """Return a line for each process, and those of what has grown by more than `growth_bytes`, `THREADS` or a file."""
    lines, wrong = [], []
    for name, record in records.items():
        cells = []
        for resource, values in (
            ("memory", record.memory),
            ("threads", record.threads),
            ("files", record.files),
        ):
            first, last = thirds(values)
            scale = 1024**2 if resource == "memory" else 1
            cells.append(f"{resource} {first / scale:.1f} -> {last / scale:.1f}")
            allowed = {
                "memory": max(GROWTH * first, growth_bytes),
                "threads": THREADS,
                "files": 0.0,
            }[resource]
            if last - first > allowed:
                wrong.append(f"{name}: {cells[-1]}")
        lines.append(f"{name}: {', '.join(cells)}")
    return lines, wrong


def thirds(values: Sequence[float]) -> tuple[float, float]:
    """Return the medians of the first and the last third of the values after the warm-up.

    Raises: BenchmarkError: there are too few values.
    """
    steady = values[int(_WARM_UP * len(values)) :]
    third = len(steady) // 3
    if third == 0:
        raise BenchmarkError(f"expected at least 4 samples of each process, got {len(values)}")
    return statistics.median(steady[:third]), statistics.median(steady[-third:])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.support.soak", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument(
        "--every", type=float, default=None, help="seconds between samples (a 100th of the time)"
    )
    parser.add_argument(
        "--growth", type=float, default=GROWTH_BYTES / 1024**2, help="largest growth of memory, MiB"
    )
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args(arguments)
    every_s = options.every if options.every is not None else 0.6 * options.minutes
    try:
        with TemporaryDirectory() as folder:
            records = soak(options.minutes, every_s, options.settings, Path(folder) / "soak")
            lines, wrong = judge(records, options.growth * 1024**2)
    except BenchmarkError as error:
        sys.stderr.write(f"soak: {error}\n")
        return 1
    sys.stdout.write("\n".join(["first and last third, memory in MiB", *lines]) + "\n")
    for line in wrong:
        sys.stderr.write(f"soak: growth: {line}\n")
    return 1 if wrong else 0


def _sampled(run: subprocess.Popen[bytes], folder: Path, every_s: float) -> dict[str, Record]:
    """Sample the processes of a run while it is active."""
    deadline = time.monotonic() + _PATIENCE_S
    while active_runs.read(folder) is None:
        if run.poll() is not None or time.monotonic() > deadline:
            raise BenchmarkError(f"the run does not begin: {_last_line(folder)}")
        time.sleep(0.1)
    logs = folder / "logs"
    while active_runs.read(folder) is not None and not all(
        '"joined"' in log.read_text() for log in logs.glob("*.log")
    ):
        time.sleep(0.1)
    # A busy host stops the recorder now and then; messages that queue up meanwhile take memory,
    # part of which it keeps. Stop it once at the beginning, so that this does not count as growth.
    run.send_signal(signal.SIGSTOP)
    time.sleep(_STANDSTILL_S)
    run.send_signal(signal.SIGCONT)
    records: dict[str, Record] = {}
    while active_runs.read(folder) is not None:
        for name, process in {"recorder": run.pid, **processes_of(folder.name)}.items():
            memory_bytes = _anonymous_bytes(process)
            with suppress(psutil.Error):  # the process has just ended
                threads, files = (
                    psutil.Process(process).num_threads(),
                    psutil.Process(process).num_fds(),
                )
                if memory_bytes is not None:
                    record = records.setdefault(name, Record())
                    record.memory.append(memory_bytes)
                    record.threads.append(float(threads))
                    record.files.append(float(files))
        time.sleep(every_s)
    return records


def _anonymous_bytes(process: int) -> float | None:
    """Return the resident memory not mapped from files; None when the process has ended."""
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    found = [line.split()[1] for line in lines if line.startswith("RssAnon:")]
    return 1024.0 * float(found[0]) if found else None


def _last_line(folder: Path) -> str:
    """Return the last output line of the run's command."""
    lines = (
        (folder.parent / _OUTPUT).read_text(encoding="utf-8", errors="replace").strip().splitlines()
    )
    return lines[-1] if lines else "no output"


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C, which ends the run
    sys.exit(main())
