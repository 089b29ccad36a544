"""Watch of a run from its start to its end: progress, scripted faults, Ctrl-C, and processes that end too early.

    event                                   before the first tick          from the first tick on
    Ctrl-C, first                           the command ends at once       the coordinator ends the run
    Ctrl-C, again                           -                              the command ends at once
    a process ends with an error            the run is refused             the other processes notice it
    a process ends in order, or by script   the same, unless the recorder  the same
                                            sees a tick within 2 s

A recorder without processes of its own (`transport record`) is stopped by the first Ctrl-C: the run goes on.
"""

import math
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from transport.flight.fault_script import FaultScript
from transport.flight.local_processes import Child, Harness
from transport.flight.progress import RunProgress
from transport.flight.recorder import Recorder
from transport.flight.run_files import RunError
from transport.flight.signals import collected_signals
from transport.protocol.wire import errors_and_exit_codes as codes
from transport.protocol.wire.names import COORDINATOR

# Exit codes of a process whose run has ended, in whatever way.
_ORDERLY_ENDS = {
    0,
    codes.EXIT_UNREACHABLE,
    codes.EXIT_OVERRUN,
    codes.EXIT_DIVERGED,
    codes.EXIT_FAILED,
    codes.EXIT_COLLIDED,
    codes.EXIT_INTERRUPTED,
}
_POLL_S = 0.05
# Time for the recorder to receive the messages of ended processes, s.
_CATCH_UP_S = 2.0


@dataclass(slots=True)
class RunWatch:
    """Watch of a run by its recorder, and of the processes and faults of a run that is started here."""

    recorder: Recorder
    progress: RunProgress
    harness: Harness | None = None
    faults: FaultScript | None = None
    is_interrupted: bool = False  # whether Ctrl-C has been handed on
    # Steady-clock time at which the first process had ended before a tick.
    first_end_s: float = math.inf

    def until_end(self) -> None:
        """Show progress until the run has ended.

        Raises: KeyboardInterrupt: Ctrl-C before the first tick, or a second one. RunError: a process started
            here has ended before the run began.
        """
        goes_on = True
        with collected_signals() as signals:
            while goes_on:  # once more after the end
                goes_on = self.recorder.join(_POLL_S)
                self.progress.setup = self.recorder.setup
                self.progress.show(self.recorder.plant_state, self.recorder.started_s)
                if self.faults is not None:
                    self.faults.work()
                name = signals.next()
                if name is not None:
                    self._interrupt(name)
                self._check_early_ends()

    def _interrupt(self, name: str) -> None:
        """End the run by a signal of this name, or the recording of one that is started elsewhere."""
        if self.is_interrupted or self.recorder.started_s is None:
            raise KeyboardInterrupt(name)
        self.is_interrupted = True
        if self.harness is None:
            self.recorder.stop(name)
            return

        ending = "ending the run"
        if not self.progress.setup.scenario.has_plant:
            ending = "the team lands, then `transport release` ends the run"
        self.progress.say(f"{name}: {ending}; once more to end it at once")
        self.harness.child(COORDINATOR).signal(signal.Signals[name])

    def _check_early_ends(self) -> None:
        """Raise the error of a process that has ended before the first tick, or was never part of the run."""
        has_begun = self.recorder.control is not None or self.recorder.started_s is not None
        if self.harness is None or has_begun:
            return
        for child in self.harness.ended():
            self.first_end_s = min(self.first_end_s, time.monotonic())
            # A run may end, or kill a process by script, within its first ticks: its messages can
            # reach the recorder after a process has ended.
            is_orderly = child.code in _ORDERLY_ENDS
            is_scripted = self.faults is not None and self.faults.has_killed(child)
            is_late = time.monotonic() - self.first_end_s > _CATCH_UP_S
            if is_late or not (is_orderly or is_scripted):
                raise _ended_early(child, self.harness.logs)


def _ended_early(child: Child, logs: Path) -> RunError:
    """Return the error of a process that has ended before the run began."""
    code = child.code or 0
    error = child.last_words or "it has left no error"
    # A child refuses the same options and scenario as this command would; any other end is that of
    # a peer.
    passed_on = code if code in (codes.EXIT_USAGE, codes.EXIT_SCENARIO) else codes.EXIT_UNREACHABLE
    text = f"{child.name} {child.how_it_ended} before the run began: {error}; logs in {logs}"
    return RunError(text, passed_on)
