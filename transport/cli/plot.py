"""The command `transport plot`."""

from pathlib import Path

import typer
from typer import Option

from protocol.network.parent import stand_by
from protocol.wire.exit_codes import EXIT_INTERRUPTED, EXIT_UNREACHABLE, EXIT_UNRECORDED
from transport.cli.lazy import load
from transport.cli.options import FormatOption, RunArgument, run_folder
from transport.cli.output import Format, blame, fail
from transport.cli.run_report import show_report
from transport.log.run_folder import open_run
from transport.report.animation import animate_run, check_animation
from transport.report.report import report_run


def plot(
    given: RunArgument = None,
    output: FormatOption = Format.text,
    animation: Path | None = Option(
        None, "--animate", metavar="FILE", help="Also write an animation: .gif, .mp4 (ffmpeg)."
    ),
    pdf: bool = Option(False, "--pdf", help="Also write the figures as PDF."),
) -> None:
    """Regenerate metrics and figures of a recorded run.

    Also reads a truncated log.

    Example: transport plot runs/20260102-101500-paper --animate flight.gif
    """
    folder = run_folder(given)
    load("transport.report.figures")  # before the wait
    if not stand_by():  # started by `transport run`, which has ended
        raise typer.Exit(EXIT_UNREACHABLE)
    with blame("--animate"):
        check_animation(animation)
    run = open_run(folder, horizons=False)
    if not run.log.messages:
        fail(f"{folder / 'run.mcap'}: expected a log with messages, got one without a readable message")
    try:
        summary = report_run(run, forks=True, pdf=pdf)
    except KeyboardInterrupt:
        fail(f"interrupted; the report is not complete, make it with: transport plot {folder}", EXIT_INTERRUPTED)
    except OSError as error:
        fail(f"{folder}: cannot write the report ({error.strerror or error})", EXIT_UNRECORDED)
    show_report(folder, output, summary)
    if animation is not None:
        with blame("--animate"):
            animate_run(folder, animation)
        typer.echo(f" {animation}", err=output is Format.json)
