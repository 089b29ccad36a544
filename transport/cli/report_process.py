"""The process that reports a run: it imports while the run is simulated, and works once the run has ended."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Self

from protocol.network.parent import PARENT_PIPE, STANDBY
from transport.flight.fork_server import Started, fork_server
from transport.flight.vitals import Pulse, children_of

# Time for the process to end before it is killed.
_GRACE_S = 2.0
# A process that has been stopped for this long, or has not run although it could, s, is not waited for. Those that draw
# for it are watched as well: it waits for them.
_STOPPED_S, _IDLE_S, _LOOK_S = 2.0, 30.0, 0.25


class ReportProcess:
    """A forked `transport plot` of one run folder that waits for the end of the run; leaving the context ends it.

    It may fork in turn, to draw on several cores, which this process with its threads may not.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process: Started | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _end(self) -> None:
        """End the process, if there is one that has not ended, and those that draw for it."""
        if self._process is None:
            return
        if self._process.poll() is None:
            self._process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_GRACE_S)
            self._kill_group()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_GRACE_S)  # a tracer may keep it for longer
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):
                self._process.stdin.close()

    def prepare(self) -> None:
        """Start the process, where processes are forked."""
        if sys.platform == "linux":
            with Path(os.devnull).open("wb") as output:  # if it fails, the report is made once more, and errors told
                extra = {PARENT_PIPE: "1", STANDBY: "1"}
                self._process = fork_server().start(["plot", str(self._folder.absolute())], output, extra)

    def report(self) -> bool:
        """Let the process report, and wait for its end; return whether it has written the report.

        If not, it has ended as well: it must not write the same files as the caller, who makes the report instead.
        """
        if self._process is None or self._process.stdin is None:
            return False
        try:
            self._process.stdin.write(b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:  # it has ended
            return False
        own = Pulse(self._process.pid)
        pulses = {self._process.pid: own}
        while all(pulse.stopped_s < _STOPPED_S for pulse in pulses.values()) and own.idle_s < _IDLE_S:
            with suppress(subprocess.TimeoutExpired):
                is_written = self._process.wait(_LOOK_S) == 0
                if not is_written:
                    self._kill_group()
                return is_written
            for pid in children_of(self._process.pid):
                pulses.setdefault(pid, Pulse(pid))
            for pulse in pulses.values():
                pulse.look()
        self._end()
        return False

    def _kill_group(self) -> None:
        """Kill the process and those that draw: one that was stopped as it began does not end with its parent."""
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
