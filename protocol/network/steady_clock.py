"""The time of arrival of messages."""

import time
from collections.abc import Callable


def wall_offset_ns() -> int:
    """Return the time since 1970 less the steady clock's, ns: what a process adds to its times."""
    return time.time_ns() - time.monotonic_ns()


class SteadyClock:
    """Wall-clock time of its construction, continued by a steady clock.

    A correction of the system's clock during a run moves no time, so differences are durations.
    """

    def __init__(
        self,
        wall_ns: Callable[[], int] = time.time_ns,
        steady_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._steady_ns = steady_ns
        self._offset_ns = wall_ns() - steady_ns()

    def now_ns(self) -> int:
        """Return the time, ns since 1970."""
        return self._offset_ns + self._steady_ns()
