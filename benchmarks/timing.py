"""Stopwatches: what is compared is timed in turns, so that a slow minute of the machine hits all of it alike."""

import gc
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import threadpoolctl

from model.arrays import Array

# Calls before those that count: caches fill, modules load.
WARM_UP = 3


@dataclass(frozen=True, slots=True)
class Times:
    """Durations of one kind of thing, ms.

    Attributes:
        ms: (count,).
    """

    ms: Array

    @property
    def median(self) -> float:
        """Of all."""
        return float(np.median(self.ms))

    @property
    def p99(self) -> float:
        """99th percentile."""
        return float(np.percentile(self.ms, 99))

    def __str__(self) -> str:
        return f"{digits(self.median)} ({digits(self.p99)})"


def digits(value: float) -> str:
    """A number with three digits that count, more than a machine repeats; a dash for one that is not known."""
    if not np.isfinite(value):
        return "-"
    rounded = f"{value:#.3g}".removesuffix(".")
    return rounded if "e" not in rounded else f"{value:.0f}" if value >= 1.0 else f"{value:.0e}"


@contextmanager
def quiet() -> Iterator[None]:
    """Nothing of this process's own gets in between: no garbage collection, one thread for linear algebra.

    That is how the processes of a run are set up, too.
    """
    gc.collect()
    gc.disable()
    try:
        with threadpoolctl.threadpool_limits(1):
            yield
    finally:
        gc.enable()


def in_turns(
    tasks: Mapping[str, Callable[[], object]], repetitions: int, clock: Callable[[], int] = time.thread_time_ns
) -> dict[str, Times]:
    """Do each task once, then each again, and so on; what each call took.

    Args:
        tasks: By name.
        repetitions: Of each, after `WARM_UP` that do not count.
        clock: Nanoseconds; processor time of this thread, so that other programs matter little.
    """
    taken: dict[str, list[int]] = {name: [] for name in tasks}
    with quiet():
        for turn in range(-WARM_UP, repetitions):
            for name, task in tasks.items():
                start = clock()
                task()
                end = clock()
                if turn >= 0:
                    taken[name].append(end - start)
    return {name: Times(np.array(ns) / 1e6) for name, ns in taken.items()}
