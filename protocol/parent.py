"""A process that was started by another of this project ends with it."""

import ctypes
import os
import signal
from contextlib import suppress

# Set by a parent that wants its children to end with it: they watch their standard input for its end.
PARENT_PIPE = "PAYLOAD_TRANSPORT_PARENT_PIPE"

_PR_SET_PDEATHSIG = 1  # <sys/prctl.h>


def wake_with_its_end() -> None:
    """If a parent started this process, let it run on when the parent dies: frozen, it would never notice.

    Linux alone can do that; elsewhere a process that is frozen when its parent is killed stays so.
    """
    if os.environ.get(PARENT_PIPE):
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGCONT, 0, 0, 0)
