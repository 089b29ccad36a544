"""The process that reports a run: it imports while the run is simulated, and works once the run has ended."""

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Self

import psutil

from transport.flight.fork_server import STOPPED, state_of
from transport.flight.harness import Child, start_child

# A process is given up when it or one that draws for it is stopped at two looks in a row, or after the longest time.
_LOOK_S, _LONGEST_S = 1.0, 120.0


class ReportProcess:
    """A forked `transport plot` of one run folder that waits for the end of the run; leaving the context ends it.

    It may fork in turn, to draw on several cores, which this process with its threads may not.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._child: Child | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def prepare(self) -> None:
        """Start the process, where processes are forked."""
        if sys.platform == "linux":  # if it fails, the report is made once more, and errors told
            arguments = ["plot", str(self._folder.absolute())]
            self._child = start_child("report", arguments, Path(os.devnull), standby=True)

    def report(self) -> bool:
        """Let the process report, and wait for its end; return whether it has written the report.

        If not, it has ended as well: it must not write the same files as the caller, who makes the report instead.
        """
        if self._child is None or not self._child.go():
            return False
        code, stopped = None, 0
        for _ in range(round(_LONGEST_S / _LOOK_S)):
            code = self._child.wait(_LOOK_S)
            stopped = stopped + 1 if self._is_stopped(self._child.process) else 0
            if code is not None or stopped > 1:
                break
        self._end()
        return code == 0

    @staticmethod
    def _is_stopped(process: psutil.Process) -> bool:
        with suppress(psutil.Error):
            return any(state_of(found) in STOPPED.values() for found in (process, *process.children()))
        return False

    def _end(self) -> None:
        """Kill the process and those that draw for it: one that is stopped does not end with its parent."""
        if self._child is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._child.process.pid, signal.SIGKILL)
            self._child.wait(_LOOK_S)  # a tracer may keep it for longer
            self._child.close()
