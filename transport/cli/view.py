"""The command `transport view`."""

import json
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from protocol.scenario.file import ScenarioError
from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_UNREACHABLE, EXIT_USAGE
from transport.cli.options import FormatOption, HostOption, PortOption
from transport.cli.output import Format, fail
from transport.cli.recorded_run import RunArgument, run_folder
from transport.flight.live import read as read_live_run
from transport.log.run_log import LogError
from transport.viewer.process import parent_ended
from transport.viewer.server import ViewerError
from transport.viewer.viewer import LOG, open_viewer

_POLL_S = 0.1


def view(
    given: RunArgument = None,
    host: HostOption = "127.0.0.1",
    port: PortOption = 8080,
    wait: Annotated[
        float, Option("--wait", metavar="SECONDS", min=0.0, help="Time to wait for the run to start, s.")
    ] = 0.0,
    output: FormatOption = Format.text,
) -> None:
    """Show a recorded or active run in the browser.

    Payload, rods, UAVs with attitude and thrust, actual and predicted paths, links by age of plans and packet loss.
    Links of an active run can be changed, its agents killed and restarted. Ctrl-C ends the viewer, not the run.

    Example: transport view runs/20260102-101500-paper
    """
    folder, has_parent_ended = run_folder(given), parent_ended()
    try:
        _wait_for_run(folder, wait, has_parent_ended)
        if has_parent_ended():
            raise typer.Exit(EXIT_UNREACHABLE)
        # The address is the only result; viser also prints when it stops.
        result = sys.stdout
        with redirect_stdout(sys.stderr), open_viewer(folder, host, port) as viewer:
            about = {"address": viewer.address, "run": str(folder)}
            typer.echo(json.dumps(about) if output is Format.json else viewer.address, file=result)
            result.flush()
            if viewer.other_port:
                typer.echo(viewer.other_port, err=True)
            typer.echo(f"showing {folder}; Ctrl-C ends it", err=True)
            viewer.show_until(has_parent_ended)
    except KeyboardInterrupt:
        return
    except (LogError, ViewerError) as error:
        fail(str(error), EXIT_USAGE)
    except ScenarioError as error:
        fail(str(error), EXIT_SCENARIO)


def _wait_for_run(folder: Path, wait_s: float, has_parent_ended: Callable[[], bool]) -> None:
    """Wait until the run in a folder is live and has a log, or the parent has ended."""
    deadline = time.monotonic() + wait_s
    while time.monotonic() < deadline and not has_parent_ended():
        if read_live_run(folder) and (folder / LOG).exists():
            return
        time.sleep(_POLL_S)
