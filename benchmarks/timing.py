"""Processor times of calls, and how tables show them."""

import gc
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import threadpoolctl

from transport.flight.header import machine

# Calls that are not counted, while caches fill and modules load.
WARM_UP = 3


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


def times_ms(calls: Sequence[Callable[[], object]], repetitions: int = 5) -> list[float]:
    """Return the processor times of this thread for calls, each repeated after a warm-up, ms."""
    found = []
    with quiet():
        for call in calls:
            for i in range(WARM_UP + repetitions):
                start_ns = time.thread_time_ns()
                call()
                if i >= WARM_UP:
                    found.append((time.thread_time_ns() - start_ns) / 1e6)
    return found


def digits(value: float) -> str:
    """Return a number with three significant digits, more than a machine repeats; a dash for an unknown one."""
    if not np.isfinite(value):
        return "-"
    rounded = f"{value:#.3g}".removesuffix(".")
    return rounded if "e" not in rounded else f"{value:.0f}" if value >= 1.0 else f"{value:.0e}"


def spread(ms: Sequence[float]) -> str:
    """Return median and 99th percentile."""
    return f"{digits(float(np.median(ms)))} ({digits(float(np.percentile(ms, 99)))})"


def origin() -> str:
    """Return the machine and the date."""
    return f"{machine()}, Python {platform.python_version()}; {time.strftime('%Y-%m-%d')}"
