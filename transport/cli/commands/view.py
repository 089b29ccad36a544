"""Command `transport view`: a recorded or active run in the browser."""

import sys
import time
from contextlib import redirect_stdout
from pathlib import Path

import orjson
import typer
from typer import Option

from transport.cli.options import FormatOption, HostOption, PortOption, RunArgument, run_folder
from transport.cli.output import Format
from transport.flight.active_runs import read as read_live_run
from transport.flight.signals import take_interrupt
from transport.protocol.wire.errors_and_exit_codes import EXIT_UNREACHABLE
from transport.viewer.viewer import LOG, open_viewer
from transport.viewer.viewer_process import parent_ended

_POLL_S = 0.1


def view(
    given: RunArgument = None,
    host: HostOption = "127.0.0.1",
    port: PortOption = 8080,
    wait: float = Option(
        0.0, metavar="SECONDS", min=0.0, help="Time to wait for the run to start, s."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Show a recorded or active run in the browser.

    Payload, rods, UAVs with attitude and thrust, actual and predicted paths, links by age of plans.
    Links of an active run can be changed, its agents killed and restarted. Ctrl-C ends the viewer,
    not the run.

    Example: transport view runs/20260102-101500-paper
    """
    # A run that is waited for has no folder yet.
    folder = given if given is not None and wait > 0.0 else run_folder(given)
    has_parent_ended = parent_ended()
    result = sys.stdout  # for the address alone: viser also prints when it stops
    try:
        deadline_s = time.monotonic() + wait
        while time.monotonic() < deadline_s and not has_parent_ended() and not _has_begun(folder):
            time.sleep(_POLL_S)
        if has_parent_ended():
            raise typer.Exit(EXIT_UNREACHABLE)

        with redirect_stdout(sys.stderr), open_viewer(folder, host, port) as viewer:
            content = {"address": viewer.address, "run": str(folder)}
            is_json = output is Format.json
            text = orjson.dumps(content).decode() if is_json else viewer.address
            typer.echo(text, file=result)
            result.flush()

            typer.echo(f"showing {folder}; Ctrl-C ends it", err=True)
            viewer.show_until(has_parent_ended)
    except KeyboardInterrupt:
        take_interrupt()
        return


def _has_begun(folder: Path) -> bool:
    """Return whether the run in a folder is live and has a log."""
    return read_live_run(folder) is not None and (folder / LOG).exists()
