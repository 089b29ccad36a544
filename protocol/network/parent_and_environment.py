"""Contract between parent and child process: environment, start signal, end."""

import os
import signal
import sys
from contextlib import suppress

# Set by a parent whose children end with it: they watch their standard input for its end.
PARENT_PIPE = "PAYLOAD_TRANSPORT_PARENT_PIPE"
# Set by a parent for a child that is started ahead of time: it waits for a byte on its standard
# input.
STANDBY = "PAYLOAD_TRANSPORT_STANDBY"

# First argument of the command that is the fork server (`transport.flight.fork_server`).
FORK_SERVER = "fork-server"

# One thread for linear algebra per process, and few for Zenoh: a run has more processes than a host
# has cores. Three that receive: closing the connection to a frozen process blocks one of them for
# seconds.
ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "ZENOH_RUNTIME": "(rx:(worker_threads:3),acc:(handover:net),app:(handover:net))",
    "PYTHONUNBUFFERED": "1",
    # Pydantic looks through all installed packages for plugins, which takes 10 ms.
    "PYDANTIC_DISABLE_PLUGINS": "__all__",
}

_PR_SET_PDEATHSIG = 1  # <sys/prctl.h>


def ending_signals() -> list[signal.Signals]:
    """Return the signals that end a process in order.

    Without SIGHUP where the user has it ignored (nohup).
    """
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    return numbers


def python(module: str) -> list[str]:
    """Return the command that starts a module of this project.

    The current folder is not on its path: a `model.py` there hides nothing.
    """
    return [sys.executable, "-P", "-m", module]


def wake_with_its_end() -> None:
    """Let the death of a parent continue this process if it is stopped. Linux only."""
    if os.environ.get(PARENT_PIPE):
        import ctypes  # 10 ms that a command without a parent saves

        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGCONT, 0, 0, 0)


def is_standby() -> bool:
    """Return whether this process is to wait for a start signal."""
    return bool(os.environ.get(STANDBY))


def stand_by() -> bool:
    """Wait for the start signal if there is to be one; return whether the parent is there."""
    if not is_standby():
        return True
    return bool(os.read(sys.stdin.fileno(), 1))
