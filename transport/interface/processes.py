"""Simulation of a run with processes, for `transport.fly`."""

from pathlib import Path

from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_INTERRUPTED
from transport.flight import run as processes_run
from transport.flight.fork_server import close_fork_server
from transport.flight.run_error import RunError
from transport.flight.run_files import new_folder
from transport.interface.progress import console
from transport.interface.run import Run
from transport.interface.scenario import Scenario
from transport.log.run_folder import open_run
from transport.report.report import write_report

RUNS = Path("runs")


def simulate(scenario: Scenario, setup: Setup, folder: Path | None, *, shown: bool) -> Run:
    """Simulate a run with processes into a folder, by default a new one in `RUNS`, and return it.

    Raises: RunError, HarnessError: the processes cannot be started. KeyboardInterrupt: Ctrl-C; no process is left.
    """
    target = new_folder(RUNS, setup.scenario.name) if folder is None else folder
    try:
        finished = processes_run.simulate(setup, target, console(shown=shown))
    except RunError as error:
        if error.exit_code == EXIT_INTERRUPTED:
            raise KeyboardInterrupt(str(error)) from None
        raise
    finally:
        close_fork_server()
    write_report(finished.folder, setup=setup)
    if finished.exit_code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt(f"interrupted; recorded in {finished.folder}")
    recorded = open_run(finished.folder, setup=setup)
    return Run(scenario, setup, recorded.log, finished.folder)
