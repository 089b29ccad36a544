"""One run on this machine as a user sees it: viewer, processes, record and report."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

import typer
from rich.console import Console

from transport.cli.lazy import load
from transport.cli.options import RUNS
from transport.cli.output import Format, fail
from transport.cli.report_process import ReportProcess
from transport.flight.run_execution import simulate
from transport.log.run_folder import new_folder
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import EXIT_INTERRUPTED
from transport.viewer.server import require_viser
from transport.viewer.viewer_process import ViewerBeside


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
