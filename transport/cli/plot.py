"""The command `transport plot`."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from protocol.network.parent import stand_by
from protocol.scenario.file import ScenarioError
from protocol.wire.exit_codes import (
    EXIT_INTERRUPTED,
    EXIT_SCENARIO,
    EXIT_UNREACHABLE,
    EXIT_UNRECORDED,
    EXIT_USAGE,
)
from transport.cli.lazy import load
from transport.cli.options import FormatOption
from transport.cli.output import Format, exit_on, fail
from transport.cli.recorded_run import RunArgument, run_folder
from transport.cli.run_report import show
from transport.log.run_folder import open_run
from transport.log.run_log import LogError
from transport.report.animation import AnimationError, animate_run, check_animation
from transport.report.report import report_run


def plot(
    given: RunArgument = None,
    output: FormatOption = Format.text,
    animation: Annotated[
        Path | None, Option("--animate", metavar="FILE", help="Also write an animation: .gif, .mp4 (ffmpeg).")
    ] = None,
    pdf: Annotated[bool, Option("--pdf", help="Also write the figures as PDF.")] = False,
) -> None:
    """Regenerate metrics and figures of a recorded run.

    Also reads a truncated log.

    Example: transport plot runs/20260102-101500-paper --animate flight.gif
    """
    folder = run_folder(given)
    load("transport.report.figures")  # before the wait
    if not stand_by():  # started by `transport run`, which has ended
        raise typer.Exit(EXIT_UNREACHABLE)
    with exit_on(AnimationError, code=EXIT_USAGE, option="--animate"):
        check_animation(animation)
    with exit_on(LogError, code=EXIT_USAGE), exit_on(ScenarioError, code=EXIT_SCENARIO):
        run = open_run(folder, horizons=False)
    if not run.log.messages:
        log = folder / "run.mcap"
        fail(f"{log}: expected a log with messages, got one without a readable message", EXIT_USAGE)
    try:
        summary = report_run(run, forks=True, pdf=pdf)
    except KeyboardInterrupt:
        fail(f"interrupted; the report is not complete, make it with: transport plot {folder}", EXIT_INTERRUPTED)
    except OSError as error:
        fail(f"{folder}: cannot write the report ({error.strerror or error})", EXIT_UNRECORDED)
    show(folder, output, summary)
    if animation is not None:
        with exit_on(AnimationError, LogError, OSError, code=EXIT_USAGE, option="--animate"):
            animate_run(folder, animation)
        typer.echo(f" {animation}", err=output is Format.json)
