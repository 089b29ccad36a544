"""A long flight in real time: whether anything grows. `python -m benchmarks.soak --minutes 30`.

All processes of a run hover at the pace of the clock, and the system is asked for what each uses. What is compared is
the first and the last third of the time after the first tenth of it: by then caches are full. Exit code 0 only if
memory is flat, threads and open files are as many as before, and no more deadlines are missed than before; deadlines in
seconds in which a virtual machine's host took a processor away (`steal` in /proc/stat) are left out.

Memory is what a process has of its own, without what it maps of files: how much of a library is in memory is for the
system to decide.
"""

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import time
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

from mcap.reader import make_reader

from benchmarks.page import BenchmarkError, Table
from protocol.network.health import command_of, usage
from protocol.wire.keys import RECORDER
from transport.flight import live
from transport.flight.run import machine

# What is left out as the time in which caches fill.
_WARM_UP = 0.1

# Memory is flat if its median grows by no more than this over two thirds of the time: what an allocator wavers by.
GROWTH, GROWTH_BYTES = 0.02, 2 * 1024**2

# Threads of a pool that has nothing to do come and go.
THREADS = 2

# Deadlines missed in the last third beyond those in the first, per tick. A host has moods.
MISSES = 0.02

# A second of which the host took so much of one processor's time, and the one after it, say nothing about this program.
_STOLEN_S = 0.02

# How late a tick can be opened without anybody having missed a deadline: what timers are off by.
_LATE_NS = 5_000_000

_PATIENCE_S = 60.0
_STANDSTILL_S = 3.0
_OUTPUT = "output.log"


@dataclass(slots=True)
class Record:
    """What a process used, over time.

    Attributes:
        memory: Bytes.
        threads: How many.
        files: Open ones.
    """

    memory: list[float] = field(default_factory=list)
    threads: list[float] = field(default_factory=list)
    files: list[float] = field(default_factory=list)


def soak(
    minutes: float, every_s: float, settings: Sequence[str], folder: Path
) -> tuple[dict[str, Record], list[int | None]]:
    """Fly, and watch.

    Args:
        minutes: How long.
        every_s: How often to look.
        settings: Further ones of the scenario.
        folder: Run folder to create.
    Returns: What each process used by name, and the deadlines missed in each tick, None where the host was away.
    Raises: BenchmarkError: the run does not begin, or does not complete.
    """
    hover = f"maneuver.phase=[{{name='hover',duration_s={60.0 * minutes},displacement_m=[0.0,0.0,0.0]}}]"
    chosen = ["clock.mode=realtime", "clock.speed=1", hover, *settings]
    words = [sys.executable, "-m", "transport", "run", "resilient", "--out", str(folder), "--no-figures"]
    words += [part for setting in chosen for part in ("--set", setting)]
    with (folder.parent / _OUTPUT).open("wb") as output:
        run = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
    stolen = Stolen()
    try:
        records = _watched(run, folder, every_s, stolen)
        code = run.wait(_PATIENCE_S + 60.0 * minutes)  # the report takes its time, too
    finally:
        run.terminate()
        run.wait()
    if code != 0:
        raise BenchmarkError(f"transport run: expected exit code 0, got {code}: {_said(folder)}")
    return records, _missed(folder / "run.mcap", stolen)


def judge(
    records: Mapping[str, Record],
    missed: Sequence[int | None],
    misses: float = MISSES,
    growth_bytes: float = GROWTH_BYTES,
) -> tuple[Table, list[str]]:
    """The table of what was used, and what is wrong with it.

    Args:
        records: By process.
        missed: Deadlines in each tick; None for a tick that does not count.
        misses: By how many per tick the last third may have more than the first.
        growth_bytes: By how much memory may grow, if that is more than `GROWTH` of it.
    """
    rows, wrong = [], []
    for name, record in records.items():
        cells = []
        for what, values in (("memory", record.memory), ("threads", record.threads), ("files", record.files)):
            first, last = thirds(values)
            cells.append(_cell(what, first, last))
            allowed = {"memory": max(GROWTH * first, growth_bytes), "threads": THREADS, "files": 0.0}[what]
            if last - first > allowed:
                wrong.append(f"{name}: {what} {cells[-1]}")
        rows.append([name, *cells])
    third = len(missed) // 3
    parts = [[count for count in part if count is not None] for part in (missed[:third], missed[-third:])]
    before, after = (sum(part) / max(1, len(part)) for part in parts)
    counted = " and ".join(str(len(part)) for part in parts)
    rows.append(["deadlines missed per tick", f"{before:.3f} -> {after:.3f}", "", ""])
    if after - before > misses:
        wrong.append(f"deadlines missed per tick: {before:.3f} in the first third, {after:.3f} in the last")
    text = f"First and last third, {len(missed)} ticks, deadlines of {counted} of them; {machine()}."
    return Table(text=text, columns=["process", "memory, MiB", "threads", "open files"], rows=rows), wrong


def thirds(values: Sequence[float]) -> tuple[float, float]:
    """Medians of the first and the last third of what comes after the warm-up.

    Raises: BenchmarkError: there are too few values for that.
    """
    steady = values[int(_WARM_UP * len(values)) :]
    third = len(steady) // 3
    if third == 0:
        raise BenchmarkError(f"expected at least 4 looks at each process, got {len(values)}")
    return statistics.median(steady[:third]), statistics.median(steady[-third:])


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--every", type=float, default=None, help="seconds between looks; a 100th of the time")
    parser.add_argument(
        "--misses", type=float, default=MISSES, help="deadlines per tick by which the last third may differ"
    )
    parser.add_argument(
        "--growth", type=float, default=GROWTH_BYTES / 1024**2, help="MiB by which memory may grow between the thirds"
    )
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    asked = parser.parse_args(arguments)
    every_s = asked.every if asked.every is not None else 0.6 * asked.minutes
    try:
        with TemporaryDirectory() as folder:
            flown = soak(asked.minutes, every_s, asked.settings, Path(folder) / "soak")
            table, wrong = judge(*flown, asked.misses, asked.growth * 1024**2)
    except BenchmarkError as error:
        sys.stderr.write(f"soak: {error}\n")
        return 1
    sys.stdout.write(f"{table}\n")
    for line in wrong:
        sys.stderr.write(f"soak: it grew: {line}\n")
    return 1 if wrong else 0


class Stolen:
    """The seconds in which the host of a virtual machine took a processor away.

    Args:
        path: Where a Linux kernel counts that time.
    """

    def __init__(self, path: Path = Path("/proc/stat")) -> None:
        self._path = path
        self._total_s, self._at_s = self._read(), time.time()
        self._spans: list[tuple[float, float]] = []

    def look(self) -> None:
        """Take note of what was stolen since the last look."""
        total_s, at_s = self._read(), time.time()
        if total_s - self._total_s >= _STOLEN_S:
            self._spans.append((self._at_s, at_s + 1.0))
        self._total_s, self._at_s = total_s, at_s

    def covers(self, at_s: float) -> bool:
        """Whether an instant, s since 1970, is in one of them or in the second after it."""
        k = bisect_right(self._spans, at_s, key=lambda span: span[0]) - 1
        return any(begin <= at_s < end for begin, end in self._spans[max(0, k - 1) : k + 1])

    def _read(self) -> float:
        try:
            ticks = int(self._path.read_text(encoding="ascii").split("\n", 1)[0].split()[8])
        except (OSError, ValueError, IndexError):
            return 0.0  # no virtual machine
        return ticks / os.sysconf("SC_CLK_TCK")


def _watched(run: subprocess.Popen[bytes], folder: Path, every_s: float, stolen: Stolen) -> dict[str, Record]:
    """Look at the processes of a run as long as it flies."""
    deadline = time.monotonic() + _PATIENCE_S
    while live.read(folder) is None:
        if run.poll() is not None or time.monotonic() > deadline:
            raise BenchmarkError(f"the run does not begin: {_said(folder)}")
        time.sleep(0.1)
    logs = folder / "logs"
    while live.read(folder) is not None and not all('"joined"' in log.read_text() for log in logs.glob("*.log")):
        time.sleep(0.1)
    # A busy host lets the recorder stand still now and then, and what comes meanwhile takes room, some of which it
    # keeps. Once at the beginning, so that this is no growth later.
    run.send_signal(signal.SIGSTOP)
    time.sleep(_STANDSTILL_S)
    run.send_signal(signal.SIGCONT)
    records: dict[str, Record] = {}
    while live.read(folder) is not None:
        for name, process in {RECORDER: run.pid, **_children(run.pid)}.items():
            used, memory_bytes = usage(str(process)), _own_memory_bytes(process)
            if memory_bytes is None or used["threads"] is None or used["open_files"] is None:
                continue  # it has just ended
            record = records.setdefault(name, Record())
            record.memory.append(memory_bytes)
            record.threads.append(float(used["threads"]))
            record.files.append(float(used["open_files"]))
        wake_s = time.monotonic() + every_s
        while (left_s := wake_s - time.monotonic()) > 0.0:
            time.sleep(min(left_s, 1.0))
            stolen.look()
    return records


def _own_memory_bytes(process: int) -> float | None:
    """Resident memory that is no file's; None when the process has ended."""
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    found = [line.split()[1] for line in lines if line.startswith("RssAnon:")]
    return 1024.0 * float(found[0]) if found else None


def _said(folder: Path) -> str:
    """The last line of what the command of a run said."""
    lines = (folder.parent / _OUTPUT).read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "it said nothing"


def _children(parent: int) -> dict[str, int]:
    """Processes of a run by name, from the system's own table."""
    found = {}
    for number in (Path("/proc") / str(parent) / "task" / str(parent) / "children").read_text().split():
        words = command_of(number)
        if "transport" in words:
            role = words[words.index("transport") + 1]
            found[f"agent{words[words.index('--id') + 1]}" if role == "agent" else role] = int(number)
    return found


def _missed(log: Path, stolen: Stolen) -> list[int | None]:
    """Deadlines missed by tick: how many agents had not answered when the tick after was opened, or that it was late.

    The latter is what a run shows that waits for the late (`clock.on_overrun=hold`).
    """
    with log.open("rb") as stream:
        topics = make_reader(stream).iter_messages(topics=["/tick"])
        ticks = [(json.loads(message.data), message.publish_time / 1e9) for _, _, message in topics]
    ticks.sort(key=lambda entry: int(entry[0]["tick"]))
    return [
        None
        if stolen.covers(at_s)
        else max(len(set(tick["members"]) - set(after["answered"])), int(after["late_ns"] > _LATE_NS))
        for (tick, _), (after, at_s) in pairwise(ticks)
    ]


def _cell(what: str, first: float, last: float) -> str:
    scale, form = (1024**2, ".1f") if what == "memory" else (1, ".0f")
    return f"{first / scale:{form}} -> {last / scale:{form}}"


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: what it has started ends with it
    sys.exit(main())
