"""The floor of any exchange between two processes here: bytes to another one and back over a pair of pipes."""

import subprocess
import sys
import time

import numpy as np

from benchmarks.timing import WARM_UP, Times

# The other process, as bare as it gets in Python.
_ECHO = "import os\nwhile data := os.read(0, {size}):\n    os.write(1, data)\n"


def round_trips(count: int, size: int) -> Times:
    """Wall-clock time of messages there and back, one after the other.

    Args:
        count: How many.
        size: Bytes of each, at most what a pipe takes at once (4096).
    """
    message = bytes(size)
    taken = []
    command = [sys.executable, "-S", "-c", _ECHO.format(size=size)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0) as echo:
        if echo.stdin is None or echo.stdout is None:
            raise RuntimeError("pipes were asked for")
        for turn in range(-WARM_UP, count):
            start = time.perf_counter_ns()
            echo.stdin.write(message)
            echo.stdout.read(size)
            if turn >= 0:
                taken.append(time.perf_counter_ns() - start)
        echo.stdin.close()
    return Times(np.array(taken) / 1e6)
