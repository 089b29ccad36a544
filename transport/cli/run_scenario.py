"""The work of `transport run`: its imports take long, so the fork server is started before them (`transport.__main__`).

For the same reason the report is imported after the simulation.
"""

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from rich.console import Console

from protocol.wire.exit_codes import EXIT_INTERRUPTED, EXIT_UNREACHABLE, EXIT_USAGE
from transport.cli.lazy import load
from transport.cli.options import RUNS
from transport.cli.output import Format, exit_on, fail
from transport.cli.report_process import ReportProcess
from transport.cli.scenario_setup import read_setup
from transport.flight.harness import HarnessError
from transport.flight.run import RunError, new_folder, simulate
from transport.viewer.process import ViewerBeside, viewer_beside
from transport.viewer.server import ViewerError, require_viser


def run_scenario(
    scenario: str,
    settings: list[str] | None,
    out: Path | None,
    output: Format,
    *,
    figures: bool,
    viewer_address: tuple[str, int] | None,
) -> None:
    """Run a scenario, record and report it; arguments are the options of `transport run`."""
    setup = read_setup(scenario, settings)
    folder = out if out is not None else new_folder(RUNS, setup.scenario.name)
    viewer: AbstractContextManager[ViewerBeside | None] = nullcontext()
    if viewer_address is not None:
        with exit_on(ViewerError, code=EXIT_USAGE):
            require_viser()
        viewer = viewer_beside(folder, *viewer_address, setup.scenario.clock.join_timeout_s)
    with viewer as beside:
        with ReportProcess(folder) as reporter:
            prepare = reporter.prepare if figures else lambda: None
            with exit_on(RunError), exit_on(HarnessError, code=EXIT_UNREACHABLE):
                ready = beside.wait_until_ready if beside is not None else lambda: None
                finished = simulate(setup, folder, Console(stderr=True), prepare, ready)
            run_report = load("transport.cli.run_report")
            if reporter.report():
                run_report.show_written(folder, output)
            else:
                run_report.report(folder, output, figures=figures, setup=setup)
        if beside is not None and finished.exit_code != EXIT_INTERRUPTED:
            beside.wait_for_user()
    if finished.exit_code != 0:
        fail(finished.reason, finished.exit_code)
