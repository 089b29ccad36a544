"""Command `transport run`: its viewer, processes, record and report.

The imports take long, so the fork server is started before them (`transport.__main__`), and the
report is imported after the simulation.
"""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from itertools import chain
from pathlib import Path
from typing import Self

import typer
from rich.console import Console
from typer import Option

from transport.cli import options
from transport.cli.lazy import load
from transport.cli.output import Format, fail
from transport.flight.harness import Child, start_child
from transport.flight.run import simulate
from transport.flight.run_files import new_folder
from transport.mpc.settings import AloneGains
from transport.protocol.network.endpoints import process_names
from transport.protocol.scenario.checks.relations import after_the_end
from transport.protocol.scenario.setup.acting_alone import lacks
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.exit_codes import EXIT_INTERRUPTED
from transport.protocol.wire.names import COORDINATOR
from transport.viewer.process import ViewerBeside
from transport.viewer.server import require_viser

# Time after which a process that does not end is given up and killed, s.
_LONGEST_S = 120.0
# Time that killing takes at most, s.
_KILLED_S = 1.0


def run(
    scenario: options.ScenarioArgument = "paper",
    settings: options.SetOption = None,
    out: Path | None = Option(
        None, metavar="FOLDER", help="Run folder to create; by default runs/<time>-<scenario>."
    ),
    output: options.FormatOption = Format.text,
    figures: options.FiguresOption = True,
    external: list[str] | None = Option(
        None, metavar="NAME", help="Process that you start yourself: plant, agent1, ... Repeatable."
    ),
    view: bool = Option(False, "--view", help="Show the run in the browser, live and afterwards."),
    host: options.HostOption = "127.0.0.1",
    port: options.PortOption = 8080,
    allow_large: options.LargeOption = False,
) -> None:
    """Run a scenario with all its processes; record and report it.

    Starts one process per agent, a plant and a coordinator; writes log, metrics and figures to a
    run folder.

    Example: transport run paper --set controller.relaxation=0.5 --out runs/relaxed
    """
    setup = options.read_setup(scenario, settings, allow_large=allow_large)
    started_by_user = external or []
    _check_external(setup, started_by_user)
    for problem in chain(after_the_end(setup.scenario), lacks(setup.alone)):
        typer.echo(f"warning: {problem}", err=True)
    if setup.alone is not None and setup.alone.gains != AloneGains():
        typer.echo(f"UAVs alone: {setup.alone.in_words()}", err=True)
    folder = out if out is not None else new_folder(options.RUNS, setup.scenario.name)

    viewer: ViewerBeside | nullcontext[None] = nullcontext()
    if view:
        require_viser()
        viewer = ViewerBeside(folder, host, port, setup.scenario.clock.join_timeout_s)

    console = Console(stderr=True)
    with viewer as beside:
        with ReportProcess(folder) as reporter, _interrupts_told(folder):
            prepare = reporter.prepare if figures else lambda: None
            ready = beside.wait_until_ready if beside is not None else lambda: None
            finished = simulate(setup, folder, console, prepare, ready, started_by_user)

            reporter.begin()  # reports while this process imports what shows it
            plot = load("transport.cli.plot")
            is_written = reporter.report()
            plot.report(folder, output, figures=figures, setup=setup, is_written=is_written)

        if finished.exit_code != 0:
            typer.echo(f"transport: {finished.reason}", err=True)
        if beside is not None and finished.exit_code != EXIT_INTERRUPTED:
            beside.wait_for_user()

    raise typer.Exit(finished.exit_code)


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


def _check_external(setup: Setup, external: list[str]) -> None:
    """End the command if a process that is not to be started does not exist.

    Scripted faults act only on processes of the run, so one with faults is refused, too.
    """
    names = [name for name in process_names(setup.scenario) if name != COORDINATOR]
    for name in external:
        if name not in names:
            fail(f"--external: expected one of {', '.join(names)}, got {name!r}")

        if any(fault.target == name for fault in setup.faults):
            expected = "a process without scripted faults, which act only on processes of the run"
            fail(f"--external: expected {expected}, got {name!r}")


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
            self._child = start_child("report", arguments, Path(os.devnull), standby=True)

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
