"""A command that runs beside the tests until one of them wants to know what came of it."""

import subprocess
import sys
from collections.abc import Sequence

# Two minutes in real time. Whoever is late is waited for: on a host that is busy with other tests the flight would be
# lost otherwise. And as what a host does to others is not the run's, deadlines may be missed more often in one third
# than in another, and what waits for a process that stands still may take twice the room it may in thirty minutes:
# what is found in two is a loss of 3 kB a tick.
SOAK = (
    "-m",
    "benchmarks.soak",
    "--minutes",
    "2",
    "--misses",
    "0.25",
    "--growth",
    "4",
    "--set",
    "clock.on_overrun=hold",
)

_LEAVE_S = 20.0


class Beside:
    """One command of this interpreter.

    Args:
        arguments: Of the interpreter.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        self._arguments = arguments
        self._process: subprocess.Popen[str] | None = None

    def begin(self) -> None:
        """Start it, if it has not been started."""
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, *self._arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )

    def result(self) -> tuple[int, str, str]:
        """Wait for its end: exit code, output, errors."""
        assert self._process is not None
        output, errors = self._process.communicate()
        return self._process.returncode, output, errors

    def end(self) -> None:
        """End it, if it runs."""
        process, self._process = self._process, None
        if process is None:
            return
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(_LEAVE_S)
            except subprocess.TimeoutExpired:
                process.kill()
        process.communicate()
