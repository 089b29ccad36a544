"""Health of a process: its use of the host's resources, and the offset of its wall clock."""

import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import psutil

# Address space of a process with a session of Zenoh: 1.3 GB were measured, mostly reserved for its threads.
_ADDRESS_SPACE = 2 * 2**30
# Exchanges in a measurement of a clock's offset; the quickest one counts.
_EXCHANGES = 4


@dataclass(frozen=True, slots=True)
class Offset:
    """Offset of another host's wall clock, for comparing logs of several hosts; no run compares two clocks."""

    ahead_s: float  # how much the other clock is ahead, s
    uncertainty_s: float  # bound of the error, s: half of the exchange's travel time

    @staticmethod
    def measured(ask: Callable[[], Mapping[str, Any] | None]) -> "Offset | None":
        """Measure the offset as NTP does, by the four times of an exchange (`offset`); return None without an answer.

        Source: RFC 5905, section 8.
        """
        best: Offset | None = None
        for _ in range(_EXCHANGES):
            sent_ns = time.time_ns()
            answer = ask()
            received_ns = time.time_ns()
            if answer is None or "answered_ns" not in answer:
                return best
            found = offset(sent_ns, answer["asked_ns"], answer["answered_ns"], received_ns)
            if best is None or found.uncertainty_s < best.uncertainty_s:
                best = found
        return best


def offset(sent_ns: int, asked_ns: int, answered_ns: int, received_ns: int) -> Offset:
    """Return the offset of the other clock from the times of one exchange.

    The request left at `sent_ns` and the answer arrived at `received_ns` by the own clock; the request arrived at
    `asked_ns` and the answer left at `answered_ns` by the other clock.
    """
    ahead_ns = ((asked_ns - sent_ns) + (answered_ns - received_ns)) / 2
    way_ns = (received_ns - sent_ns) - (answered_ns - asked_ns)
    return Offset(ahead_ns / 1e9, max(0, way_ns) / 2e9)


def usage(process: int | None = None) -> dict[str, float | int | None]:
    """Return memory (bytes), threads, open files and processor time (s) of a process, by default this one.

    None where they are not known.
    """
    try:
        of = psutil.Process(process)
        times = of.cpu_times()
        return {
            "memory_bytes": of.memory_info().rss,
            "threads": of.num_threads(),
            "open_files": of.num_fds(),
            "cpu_s": times.user + times.system,
        }
    except psutil.Error:
        return dict.fromkeys(("memory_bytes", "threads", "open_files", "cpu_s"))


def limit_problem(open_files: int) -> str:
    """Return which limit of this process is too low for so many open files and for Zenoh's threads; empty if none is.

    Zenoh ends a process that reaches such a limit.
    """
    for name, limit, needed, unit, command in (
        ("open files", resource.RLIMIT_NOFILE, open_files, "", "ulimit -n"),
        ("address space", resource.RLIMIT_AS, _ADDRESS_SPACE, " bytes", "ulimit -v, in KiB"),
    ):
        allowed = resource.getrlimit(limit)[0]
        if allowed != resource.RLIM_INFINITY and allowed < needed:
            return f"{name}: expected a limit of at least {needed}{unit}, got {allowed} ({command})"
    return ""
