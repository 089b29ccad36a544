"""Timing in turns, so that a slow minute of the machine affects all that is compared alike."""

import gc
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import threadpoolctl

from model.arrays import Array

# Calls that are not counted, while caches fill and modules load.
WARM_UP = 3

# The other process of a round trip, with the least work possible in Python.
_ECHO = "import os\nwhile data := os.read(0, {size}):\n    os.write(1, data)\n"


@dataclass(frozen=True, slots=True)
class Times:
    """Durations of one kind, (count,), ms."""

    ms: Array

    @property
    def median(self) -> float:
        """Median, ms."""
        return float(np.median(self.ms))

    @property
    def cells(self) -> tuple[str, str]:
        """Median and 99th percentile, ms."""
        return digits(self.median), digits(float(np.percentile(self.ms, 99)))

    def __str__(self) -> str:
        return "{} ({})".format(*self.cells)


def joined(times: Iterable[Times]) -> Times:
    """Return all durations in one."""
    return Times(np.concatenate([one.ms for one in times]))


def digits(value: float) -> str:
    """Return a number with three significant digits, more than a machine repeats; a dash for an unknown one."""
    if not np.isfinite(value):
        return "-"
    rounded = f"{value:#.3g}".removesuffix(".")
    return rounded if "e" not in rounded else f"{value:.0f}" if value >= 1.0 else f"{value:.0e}"


@contextmanager
def quiet() -> Iterator[None]:
    """Suspend garbage collection and use one thread for linear algebra, as the processes of a run do."""
    gc.collect()
    gc.disable()
    try:
        with threadpoolctl.threadpool_limits(1):
            yield
    finally:
        gc.enable()


def in_turns(tasks: Mapping[str, Callable[[], object]], repetitions: int) -> dict[str, Times]:
    """Call each task once, then each again, and so on; return the processor time of this thread by task.

    The first `WARM_UP` calls of each come on top of the repetitions and are not counted.
    """
    taken: dict[str, list[int]] = {name: [] for name in tasks}
    with quiet():
        for _ in range(WARM_UP + repetitions):
            for name, task in tasks.items():
                start_ns = time.thread_time_ns()
                task()
                taken[name].append(time.thread_time_ns() - start_ns)
    return {name: Times(np.array(ns[WARM_UP:]) / 1e6) for name, ns in taken.items()}


def round_trips(count: int, size: int) -> Times:
    """Measure the wall-clock time of messages to another process and back over pipes: the floor of any exchange.

    Messages go one after the other and have at most the bytes that a pipe takes at once (4096).
    """
    command = [sys.executable, "-S", "-c", _ECHO.format(size=size)]
    taken: list[int] = []
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0) as echo:
        if echo.stdin is None or echo.stdout is None:
            raise RuntimeError("expected pipes, got none")
        for _ in range(WARM_UP + count):
            start_ns = time.perf_counter_ns()
            echo.stdin.write(bytes(size))
            echo.stdout.read(size)
            taken.append(time.perf_counter_ns() - start_ns)
        echo.stdin.close()
    return Times(np.array(taken[WARM_UP:]) / 1e6)
