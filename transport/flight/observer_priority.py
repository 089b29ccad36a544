"""Real-time priority of an observer: one below the processes that it observes.

Under SCHED_FIFO or SCHED_RR (`chrt`) all processes of a run inherit one priority. A batch of
messages that the recorder writes would then hold a core for as long as it takes, also when the
measurement of an agent arrives meanwhile. Other scheduling classes are left alone.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_THREADS = Path("/proc/self/task")


@contextmanager
def below_the_team() -> Iterator[None]:
    """Lower the real-time priority of all threads of this process by one for the block."""
    changed = _change(-1)
    try:
        yield
    finally:
        if changed:
            _change(1)


def _change(by: int) -> bool:
    """Change the real-time priority of this process's threads; return whether there is one."""
    if not _THREADS.is_dir() or not hasattr(os, "sched_setscheduler"):
        return False
    policy = os.sched_getscheduler(0)
    priority = os.sched_getparam(0).sched_priority + by
    is_realtime = policy in (os.SCHED_FIFO, os.SCHED_RR)
    if not is_realtime or priority < os.sched_get_priority_min(policy):
        return False

    for thread in _THREADS.iterdir():
        # A thread may have ended; raising a priority again may be forbidden.
        with suppress(ProcessLookupError, PermissionError):
            os.sched_setscheduler(int(thread.name), policy, os.sched_param(priority))
    return True
