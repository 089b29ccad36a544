"""The command `transport view`."""

import sys
import time
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from protocol.scenario.file import ScenarioError
from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_USAGE
from transport.cli.options import RUNS, HostOption, PortOption
from transport.cli.output import fail
from transport.flight.live import read as read_live_run
from transport.log.run_log import LogError
from transport.viewer.process import parent_ended
from transport.viewer.server import ViewerError
from transport.viewer.viewer import LOG, open_viewer

_POLL_S = 0.1


def view(
    folder: Annotated[
        Path | None, Argument(metavar="RUN", help="Run folder; by default the most recent below runs/.")
    ] = None,
    host: HostOption = "127.0.0.1",
    port: PortOption = 8080,
    wait: Annotated[float, Option("--wait", min=0.0, help="Time to wait for the run to start, s.")] = 0.0,
) -> None:
    """Show a recorded or active run in the browser.

    Payload, rods, UAVs with attitude and thrust, flown and predicted paths, links by age of plans and packet loss.
    Links of an active run can be changed, its agents killed and restarted. Ctrl-C ends the viewer, not the run.

    Example: transport view runs/20260102-101500-paper
    """
    folder = _newest() if folder is None else folder
    try:
        _wait_for_run(folder, wait)
        # The address is the only result; viser also prints when it stops.
        result = sys.stdout
        with redirect_stdout(sys.stderr), open_viewer(folder, host, port) as viewer:
            typer.echo(viewer.address, file=result)
            result.flush()
            typer.echo(f"showing {folder}; Ctrl-C ends it", err=True)
            viewer.show_until(parent_ended())
    except KeyboardInterrupt:
        return
    except (LogError, ViewerError) as error:
        fail(str(error), EXIT_USAGE)
    except ScenarioError as error:
        fail(str(error), EXIT_SCENARIO)


def _wait_for_run(folder: Path, wait_s: float) -> None:
    """Wait until the run in a folder is live and has a log."""
    deadline = time.monotonic() + wait_s
    while time.monotonic() < deadline and not (read_live_run(folder) and (folder / LOG).exists()):
        time.sleep(_POLL_S)


def _newest() -> Path:
    """Return the folder below runs/ with the most recent log."""
    logs = sorted(RUNS.glob(f"*/{LOG}"), key=lambda path: path.stat().st_mtime)
    if not logs:
        fail(f"expected a run folder, got none, and there is none in {RUNS}/", EXIT_USAGE)
    return logs[-1].parent
