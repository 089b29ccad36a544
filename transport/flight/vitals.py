"""Signs of life of a process on this machine, from Linux's /proc: whether its first thread runs, waits or is stopped.

The first thread does the work of a process of a run; the threads of the network may go on while it is stopped. Where
/proc is missing, every process counts as one that works.
"""

import os
import signal
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

# States of proc(5): stopped by a signal, in a trace stop; ended.
_STOPPED = {"T": "stopped by a signal", "t": "stopped by a tracer"}
_ENDED = frozenset("ZX")
# States in which a thread has work to do: it runs or waits for a processor, or for a disk.
_BUSY = frozenset("RD")
# Longest time that one look accounts for, s: an observer that was stopped itself has seen nothing of the time before.
_LOOK_S = 1.0


@dataclass(frozen=True, slots=True)
class Vitals:
    """First thread of a process: its state letter, and how long it ran and waited for a processor, s."""

    state: str
    ran_s: float
    waited_s: float


def vitals(pid: int) -> Vitals | None:
    """Return the vitals of a process, or None if it is gone or the system does not tell."""
    try:
        state = _state(Path(f"/proc/{pid}/stat"))
        ran_ns, waited_ns, _ = Path(f"/proc/{pid}/schedstat").read_text().split()
        return Vitals(state, int(ran_ns) / 1e9, int(waited_ns) / 1e9)
    except (OSError, ValueError, IndexError):
        return None


def is_stopped(pid: int) -> bool:
    """Return whether a process is stopped by a signal or a tracer."""
    found = vitals(pid)
    return found is not None and found.state in _STOPPED


def has_died(pid: int) -> bool:
    """Return whether all threads of a process have ended, also while a tracer keeps the parent from reaping it."""
    try:
        threads = list(Path(f"/proc/{pid}/task").iterdir())
    except OSError:
        return True
    for thread in threads:
        with suppress(OSError, IndexError):  # gone since
            if _state(thread / "stat") not in _ENDED:
                return False
    return True


def _state(stat: Path) -> str:
    return stat.read_text(errors="replace").rsplit(")", 1)[1].split()[0]


class Pulse:
    """Findings of repeated looks at a process.

    Time counts only while it is looked at, and not while the process waits for a processor, so that a busy host or a
    stopped observer does not make a process look dead.

    Attributes:
        stopped_s: How long it has been stopped, s.
        idle_s: How long it has not run, although it was not waiting for a processor or a disk, s.
        given_s: How long it could have run since the first look, s: time less the time it waited for a processor.
        ran_s: Processor time of its first thread, s.
    """

    def __init__(self, pid: int) -> None:
        self.stopped_s = self.idle_s = self.given_s = self.ran_s = 0.0
        self._pid, self._last = pid, vitals(pid)
        self._looked_s = time.monotonic()

    def look(self) -> None:
        """Look at the process."""
        looked_s, self._looked_s = self._looked_s, time.monotonic()
        since_s = min(self._looked_s - looked_s, _LOOK_S)
        last, self._last = self._last, vitals(self._pid)
        now = self._last
        if last is None or now is None:
            self.given_s += since_s
            return
        self.ran_s = now.ran_s
        self.given_s += max(0.0, since_s - max(0.0, now.waited_s - last.waited_s))
        has_run = now.ran_s > last.ran_s
        is_stopped = now.state in _STOPPED and not has_run
        self.stopped_s = self.stopped_s + since_s if is_stopped else 0.0
        self.idle_s = 0.0 if has_run or now.state in _BUSY else self.idle_s + since_s

    @property
    def description(self) -> str:
        """State of the process in words: "stopped by a tracer", "asleep", "busy"."""
        state = "" if self._last is None else self._last.state
        return _STOPPED.get(state, "busy" if state in _BUSY else "asleep")


def children_of(pid: int) -> list[int]:
    """Return the process ids of a process's children, whichever thread has started them; none if it is gone."""
    found: list[int] = []
    with suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with suppress(OSError):  # the thread is gone since
                found += map(int, (thread / "children").read_text().split())
    return found


def kill_leftovers(parent: int, titles: frozenset[str], spared: frozenset[int]) -> bool:
    """Kill the children of a process whose command line is one of these; return whether there were any."""
    found = False
    for pid in children_of(parent):
        with suppress(OSError):  # gone since
            title = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
            if pid not in spared and title in titles and not has_died(pid):
                os.kill(pid, signal.SIGKILL)
                found = True
    return found
