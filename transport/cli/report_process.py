"""The process that reports a run: it imports while the run is simulated, and works once the run has ended."""

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Self

from transport.flight.harness import Child, start_child

# A process that does not end is given up after this long, and killed, which takes at most the second time.
_LONGEST_S, _KILLED_S = 120.0, 1.0


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
        code = self._child.wait(_LONGEST_S)
        self._end()
        return code == 0

    def _end(self) -> None:
        """Kill the process and those that draw for it."""
        if self._child is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._child.process.pid, signal.SIGKILL)
            self._child.wait(_KILLED_S)
            self._child.close()
