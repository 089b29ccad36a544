"""Timing in turns, so that a slow minute of the machine affects all that is compared alike."""

import gc
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import threadpoolctl

from model.arrays import Array

# Calls that are not counted, while caches fill and modules load.
WARM_UP = 3


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
