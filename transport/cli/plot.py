"""The command `transport plot`."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from protocol.wire.exit_codes import EXIT_USAGE
from transport.cli.options import FormatOption
from transport.cli.output import Format, exit_on, fail
from transport.cli.run_report import report
from transport.log.run_log import LogError, read_log
from transport.report.animation import AnimationError, animate_run, check_animation


def plot(
    folder: Annotated[Path, Argument(help="Run folder.")],
    output: FormatOption = Format.text,
    animation: Annotated[
        Path | None, Option("--animate", metavar="FILE", help="Also write an animation: .gif, .mp4 (ffmpeg).")
    ] = None,
) -> None:
    """Regenerate metrics and figures of a recorded run.

    Works on a truncated log too.

    Example: transport plot runs/20260102-101500-paper --animate flight.gif
    """
    with exit_on(AnimationError, code=EXIT_USAGE, option="--animate"):
        check_animation(animation)
    log = folder / "run.mcap"
    with exit_on(LogError, code=EXIT_USAGE):
        if not read_log(log, horizons=False).messages:
            fail(f"{log}: expected a log with messages, got one without a readable message", EXIT_USAGE)
    report(folder, output, figures=True, setup=None)
    if animation is not None:
        with exit_on(AnimationError, LogError, OSError, code=EXIT_USAGE, option="--animate"):
            animate_run(folder, animation)
        typer.echo(f" {animation}", err=output is Format.json)
