"""One run on this machine as a user sees it: viewer, processes, record and report."""

import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Self

import typer
from rich.console import Console

from transport.cli.lazy import load
from transport.cli.options import RUNS
from transport.cli.output import Format, fail
from transport.flight.local_processes import Child, ToStart, start_children
from transport.flight.run_execution import simulate
from transport.log.run_folder import new_folder
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import EXIT_INTERRUPTED
from transport.viewer.server import require_viser
from transport.viewer.viewer_process import ViewerBeside

# Time after which a process that does not end is given up and killed, s.
_LONGEST_S = 120.0
# Time that killing takes at most, s.
_KILLED_S = 1.0


def run_and_report(
    setup: Setup,
    given: Path | None,
    external: Sequence[str],
    output: Format,
    viewer: tuple[str, int] | None,
    *,
    figures: bool,
) -> int:
    """Run a scenario with all its processes, report it, and return the exit code of the command.

    Args:
        setup: The run.
        given: Run folder to create; None for one below `runs/`, named by time and scenario.
        external: Names of processes that the user starts.
        output: Format of the summary.
        viewer: Host and port of a viewer beside the run; None without one.
        figures: Whether figures are drawn.
    """
    folder = given if given is not None else new_folder(RUNS, setup.scenario.name)
    beside: ViewerBeside | nullcontext[None] = nullcontext()
    if viewer is not None:
        require_viser()
        beside = ViewerBeside(folder, *viewer, setup.scenario.clock.join_timeout_s)

    console = Console(stderr=True)
    with beside as shown:
        with ReportProcess(folder) as reporter, _interrupts_told(folder):
            prepare = reporter.prepare if figures else lambda: None
            ready = shown.wait_until_ready if shown is not None else lambda: None
            finished = simulate(setup, folder, console, prepare, ready, external)

            reporter.begin()  # reports while this process imports what shows it
            plot = load("transport.cli.commands.plot")
            is_written = reporter.report()
            plot.report(folder, output, figures=figures, setup=setup, is_written=is_written)

        if finished.exit_code != 0:
            typer.echo(f"transport: {finished.reason}", err=True)
        if shown is not None and finished.exit_code != EXIT_INTERRUPTED:
            shown.wait_for_user()
    return finished.exit_code


@contextmanager
def _interrupts_told(folder: Path) -> Iterator[None]:
    """End the command after Ctrl-C by telling which log is kept in the run folder.

    The text names the command that reports it.
    """
    try:
        yield
    except KeyboardInterrupt:
        log = folder / "run.mcap"
        kept = f"kept {log}, report it with: transport plot {folder}"
        text = kept if log.exists() else "nothing is recorded"
        fail(f"interrupted; {text}", EXIT_INTERRUPTED)


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
