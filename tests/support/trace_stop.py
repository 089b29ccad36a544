"""Trace stop of a process, as under a debugger: `python -m tests.support.trace_stop PID [--first-thread]`.

A process in a trace stop does not react to SIGTERM and SIGCONT, only to SIGKILL, and its parent cannot reap it while
the tracer lives. Standard output says "stopped" when all threads are; the end of standard input lets the process go on.
"""

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from subprocess import PIPE, Popen

# <sys/ptrace.h>
_SEIZE, _INTERRUPT = 0x4206, 0x4207
_WALL = 0x40000000  # wait for any thread

_libc = ctypes.CDLL(None, use_errno=True)
_libc.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
_libc.ptrace.restype = ctypes.c_long


class TraceError(RuntimeError):
    """The process is gone, or this one may not trace it."""


@contextmanager
def trace_stopped(pid: int, *, first_thread: bool = False) -> Iterator[None]:
    """Hold a process in a trace stop while the context is open: all its threads, or only the first one.

    With only the first thread stopped the others serve the network, so that no peer notices.

    Raises: TraceError.
    """
    words = [sys.executable, "-m", "tests.support.trace_stop", str(pid), *(["--first-thread"] if first_thread else [])]
    with Popen(words, stdin=PIPE, stdout=PIPE, cwd=Path(__file__).parents[2]) as tracer:
        assert tracer.stdin is not None
        assert tracer.stdout is not None
        try:
            if tracer.stdout.readline() != b"stopped\n":
                raise TraceError(f"cannot trace process {pid}")
            yield
        finally:
            tracer.stdin.close()


def stop(pid: int, *, first_thread: bool) -> bool:
    """Stop the threads of a process by this one; return whether any is stopped. The kernel undoes it when this ends."""
    stopped: set[int] = set()
    while new := ({pid} if first_thread else _threads(pid)) - stopped:
        for thread in new:
            stopped.add(thread)
            if _libc.ptrace(_SEIZE, thread, None, None) == 0 and _libc.ptrace(_INTERRUPT, thread, None, None) == 0:
                with suppress(ChildProcessError):
                    os.waitpid(thread, _WALL)
    return bool(_libc.ptrace(_INTERRUPT, pid, None, None) == 0)


def _threads(pid: int) -> set[int]:
    try:
        return {int(entry.name) for entry in Path(f"/proc/{pid}/task").iterdir()}
    except OSError:
        return set()


if __name__ == "__main__":
    if stop(int(sys.argv[1]), first_thread="--first-thread" in sys.argv):
        sys.stdout.write("stopped\n")
        sys.stdout.flush()
        sys.stdin.buffer.read()
