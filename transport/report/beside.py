"""Work in a forked process while this one goes on."""

import ctypes
import os
import signal
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

_PR_SET_PDEATHSIG = 1  # <sys/prctl.h>


@contextmanager
def beside(work: Callable[[], object], *, forks: bool) -> Iterator[None]:
    """Do some work in a forked process while the block runs; without `forks` in this process, before the block.

    Only processes of one thread may fork.

    Raises: ChildProcessError: the work failed in the forked process; its traceback is on standard error.
    """
    if not forks:
        work()
        yield
        return
    parent, pid = os.getpid(), os.fork()
    if pid == 0:
        _end_with(parent)
        _do(work)
    try:
        yield
    finally:
        _, status = os.waitpid(pid, 0)
    if status:
        raise ChildProcessError(f"a forked process of the report failed (exit status {status})")


def _end_with(parent: int) -> None:
    """End this process when its parent ends: an interrupted report must not go on writing. Linux only."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it has ended before
        os._exit(1)


def _do(work: Callable[[], object]) -> None:
    """Do the work and end this process."""
    code = 1
    try:
        work()
        code = 0
    except BaseException:  # noqa: BLE001  # no caller would report it
        traceback.print_exc()
    finally:
        os._exit(code)
