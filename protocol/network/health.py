"""Health of a process: its use of the host's resources, and the offset of its wall clock."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import psutil

# Exchanges in a measurement of a clock's offset; the quickest one counts.
_EXCHANGES = 4


def clock_offset(ask: Callable[[], Mapping[str, Any] | None]) -> tuple[float, float] | None:
    """Return how much the clock of a process is ahead of this one, and a bound of the error, s; None without an answer.

    Measured as NTP does, by the four times of an exchange, for comparing logs of several hosts; no run compares two
    clocks. Source: RFC 5905, section 8.
    """
    found = []
    for _ in range(_EXCHANGES):
        sent_ns = time.time_ns()
        answer = ask()
        received_ns = time.time_ns()
        if answer is None or "answered_ns" not in answer:
            break
        there_ns, back_ns = answer["asked_ns"] - sent_ns, received_ns - answer["answered_ns"]
        found.append((max(0, there_ns + back_ns) / 2e9, (there_ns - back_ns) / 2e9))
    return min(found)[::-1] if found else None


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
