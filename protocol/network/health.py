"""How a process is: what it uses of its host, and how far its wall clock is from another's."""

import ctypes
import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Exchanges that a clock is measured by; the one that took least is believed.
_EXCHANGES = 4


@dataclass(frozen=True, slots=True)
class Offset:
    """By how much another host's wall clock is ahead.

    Only those who lay logs of several hosts side by side need it: nothing in a run compares times of two clocks.

    Attributes:
        ahead_s: Of the other clock, s.
        uncertainty_s: At most so much is wrong with it, s: half of what the exchange took on the way.
    """

    ahead_s: float
    uncertainty_s: float

    @staticmethod
    def measured(ask: Callable[[], Mapping[str, Any] | None]) -> "Offset | None":
        """The offset by four times of one exchange, as NTP has it; None if the other does not answer.

        Args:
            ask: An exchange; the answer has `asked_ns` and `answered_ns` by the other's clock.
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
    """By how much the other clock is ahead, from the times of one exchange.

    Args:
        sent_ns: When the question left, own clock.
        asked_ns: When it came, the other's clock.
        answered_ns: When the answer left, the other's clock.
        received_ns: When it came, own clock.
    """
    ahead_ns = ((asked_ns - sent_ns) + (answered_ns - received_ns)) / 2
    way_ns = (received_ns - sent_ns) - (answered_ns - asked_ns)
    return Offset(ahead_ns / 1e9, max(0, way_ns) / 2e9)


def usage(process: str = "self") -> dict[str, float | int | None]:
    """What a process uses: memory (bytes), threads, open files, processor time (s); None where that is not told.

    Args:
        process: Its id.
    """
    root = Path("/proc") / process
    try:
        fields = (root / "stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()
        tick_hz = os.sysconf("SC_CLK_TCK")
        return {
            "memory_bytes": int(fields[21]) * os.sysconf("SC_PAGE_SIZE"),
            "threads": int(fields[17]),
            "open_files": len(list((root / "fd").iterdir())),
            "cpu_s": (int(fields[11]) + int(fields[12])) / tick_hz,
        }
    except (OSError, ValueError, IndexError):
        return dict.fromkeys(("memory_bytes", "threads", "open_files", "cpu_s"))


def give_back_memory() -> None:
    """Let the C library give the system what it keeps of memory that is used no more. Others than glibc cannot."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def command_of(process: str) -> list[str]:
    """Words of a process's command line, or of the title it has given itself; none when it has ended.

    Args:
        process: Its id.
    """
    try:
        content = (Path("/proc") / process / "cmdline").read_bytes()
    except OSError:
        return []
    return content.replace(b"\0", b" ").decode(errors="replace").split()
