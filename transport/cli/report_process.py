"""The process that makes the report of a run, started while the run goes on."""

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Self

from transport.flight.local_processes import Child, ToStart, start_children

# Time after which the process is given up and killed, s.
_LONGEST_S = 120.0
# Time that killing takes at most, s.
_KILLED_S = 1.0


class ReportProcess:
    """Forked `transport plot` of one run folder that waits for the end of the run.

    Leaving the context ends it. It may fork in turn, to draw on several cores, which this process
    with its threads may not.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._child: Child | None = None
        self._reports = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def prepare(self) -> None:
        """Start the process, where processes are forked."""
        if sys.platform == "linux":  # if it fails, the report is made once more, and errors told
            arguments = ["plot", str(self._folder.absolute()), "--no-svg"]
            wanted = ToStart("report", arguments, Path(os.devnull))
            [self._child] = start_children([wanted], standby=True)

    def begin(self) -> None:
        """Let the process report, if there is one."""
        self._reports = self._child is not None and self._child.go()

    def report(self) -> bool:
        """Wait for the end of the process; return whether it has written the report.

        If not, it has ended as well: it must not write the same files as the caller, who makes the
        report instead.
        """
        if self._child is None or not self._reports:
            return False
        code = self._child.wait(_LONGEST_S)
        self._end()
        return code == 0

    def _end(self) -> None:
        """Kill the process and those that draw for it."""
        if self._child is None:
            return

        with suppress(ProcessLookupError):
            os.killpg(self._child.process.pid, signal.SIGKILL)
        self._child.wait(_KILLED_S)
        self._child.close()
