"""Work in a forked process while this one goes on."""

import ctypes
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import get_context

_PR_SET_PDEATHSIG = 1  # <sys/prctl.h>


@contextmanager
def beside(work: Callable[[], object], *, forks: bool) -> Iterator[None]:
    """Do some work in a forked process while the block runs; without `forks` in this process, before the block.

    Only processes of one thread may fork. On Linux the forked process ends with this one.

    Raises: ChildProcessError: the work failed in the forked process; its traceback is on standard error.
    """
    if not forks:
        work()
        yield
        return
    parent = os.getpid()

    def do() -> None:
        with suppress(OSError, AttributeError):  # an interrupted report must not go on writing
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() == parent:
            work()

    process = get_context("fork").Process(target=do)
    process.start()
    try:
        yield
    finally:
        process.join()
    if process.exitcode:
        raise ChildProcessError(f"a forked process of the report failed (exit status {process.exitcode})")
