"""Command `transport plot`, and the report of a run.

Summary and figures are written to the folder of the run, the summary is printed, too. The process that
only prints it imports no more than that takes.
"""

import gc
from enum import StrEnum
from pathlib import Path

import orjson
import typer
from typer import Option

from transport.cli.lazy import load
from transport.cli.options import FormatOption, RunArgument, run_folder
from transport.cli.output import Format, blame, fail, show
from transport.log.run_folder import open_run
from transport.log.run_log import LogError
from transport.protocol.network.parent_and_environment import is_standby, stand_by
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import (
    EXIT_INTERRUPTED,
    EXIT_UNREACHABLE,
    EXIT_UNRECORDED,
)
from transport.report.summary_table import summary_table, warnings


class Purpose(StrEnum):
    """What figures are written for."""

    paper = "paper"


def plot(
    given: RunArgument = None,
    output: FormatOption = Format.text,
    animation: Path | None = Option(
        None, "--animate", metavar="FILE", help="Also write an animation: .gif, .mp4 (ffmpeg)."
    ),
    svg: bool = Option(True, help="Also write the figures as SVG."),
    pdf: bool = Option(False, "--pdf", help="Also write the figures as PDF."),
    purpose: Purpose | None = Option(
        None, "--for", help="Also write figures as PDF, SVG and PNG with captions to paper/."
    ),
) -> None:
    """Regenerate metrics and figures of a recorded run.

    Also reads a truncated log.

    Example: transport plot runs/20260102-101500-paper --animate flight.gif
    """
    folder = run_folder(given)
    reports = load("transport.report.report")
    if is_standby():  # the preparations come before the wait
        load("transport.report.figures.run_figures").warm_up()
        gc.disable()  # the process ends with its report
    if not stand_by():  # started by `transport run`, which has ended
        raise typer.Exit(EXIT_UNREACHABLE)

    if animation is not None:
        from transport.report.animation import animate_run, check_animation

        with blame("--animate"):
            check_animation(animation)

    run = open_run(folder, horizons=False)
    if not run.log.messages:
        problem = "expected a log with messages, got one without a readable message"
        fail(f"{folder / 'run.mcap'}: {problem}")
    try:
        also = [kind for kind, wanted in (("svg", svg), ("pdf", pdf)) if wanted]
        summary = reports.report_run(run, forks=True, also=also)
        written = reports.write_for_paper(run, summary) if purpose is not None else []
    except KeyboardInterrupt:
        hint = f"the report is not complete, make it with: transport plot {folder}"
        fail(f"interrupted; {hint}", EXIT_INTERRUPTED)
    except OSError as error:
        fail(_unwritten(folder, error), EXIT_UNRECORDED)

    show_report(folder, output)
    for file in written:
        typer.echo(f" {file}", err=output is Format.json)
    if animation is not None:
        with blame("--animate"):
            animate_run(folder, animation)
        typer.echo(f" {animation}", err=output is Format.json)


def report(
    folder: Path, output: Format, *, figures: bool, setup: Setup, is_written: bool = False
) -> None:
    """Write the report of a run that has ended, unless it is written, and print its summary.

    If that cannot be done, or the log is gone, the exit code says that the run is not recorded.
    """
    try:
        if not is_written:
            load("transport.report.report").write_report(folder, figures=figures, setup=setup)
        show_report(folder, output)
    except OSError as error:
        fail(_unwritten(folder, error), EXIT_UNRECORDED)
    except LogError as error:
        fail(f"cannot write the report: {error}", EXIT_UNRECORDED)


def _unwritten(folder: Path, error: OSError) -> str:
    """Return the text of a report that cannot be written."""
    return f"{folder}: cannot write the report ({error.strerror or error})"


def show_report(folder: Path, output: Format) -> None:
    """Print the summary in a run folder, and the files of the folder."""
    summary = orjson.loads((folder / "summary.json").read_bytes())
    for warning in warnings(summary):
        typer.echo(f"warning: {warning}", err=True)

    figures = [f"figures/{path.name}" for path in sorted(folder.glob("figures/*.png"))]
    files = ["summary.json", "steps.csv", "run.mcap", *figures]
    show(output, summary, summary_table(summary), *(f" {folder / file}" for file in files))
