"""Health of a process: its use of the host's resources, and the offset of its wall clock."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import psutil

# Exchanges in a measurement of a clock's offset; the quickest one counts.
_EXCHANGES = 4


@dataclass(frozen=True, slots=True)
class Offset:
    """Offset of another host's wall clock, for comparing logs of several hosts; no run compares two clocks."""

    ahead_s: float  # how much the other clock is ahead, s
    uncertainty_s: float  # bound of the error, s: half of the exchange's travel time

    @staticmethod
    def measured(ask: Callable[[], Mapping[str, Any] | None]) -> "Offset | None":
        """Measure the offset as NTP does, by the four times of an exchange; return None without an answer.

        Source: RFC 5905, section 8.
        """
        found = []
        for _ in range(_EXCHANGES):
            sent_ns = time.time_ns()
            answer = ask()
            received_ns = time.time_ns()
            if answer is None or "answered_ns" not in answer:
                break
            there_ns, back_ns = answer["asked_ns"] - sent_ns, received_ns - answer["answered_ns"]
            found.append(Offset((there_ns - back_ns) / 2e9, max(0, there_ns + back_ns) / 2e9))
        return min(found, key=lambda offset: offset.uncertainty_s, default=None)


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
