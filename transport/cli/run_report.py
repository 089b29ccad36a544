"""The report of a recorded run: summary and figures in its folder, the summary on standard output."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import orjson
import typer

from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_UNRECORDED
from transport.cli.output import Format, fail, show
from transport.report.report import summary_table, warnings, write_report


def report(folder: Path, output: Format, *, figures: bool, setup: Setup) -> None:
    """Write the report of a run folder and print its summary."""
    try:
        summary = write_report(folder, figures=figures, setup=setup)
    except OSError as error:
        fail(f"{folder}: cannot write the report ({error.strerror or error})", EXIT_UNRECORDED)
    show_report(folder, output, summary)


def show_written(folder: Path, output: Format) -> None:
    """Print the summary in a run folder."""
    show_report(folder, output, orjson.loads((folder / "summary.json").read_bytes()))


def show_report(folder: Path, output: Format, summary: Mapping[str, Any]) -> None:
    """Print a summary and the files of its run folder."""
    for warning in warnings(summary):
        typer.echo(f"warning: {warning}", err=True)
    files = ["summary.json", "steps.csv", "run.mcap", *[f"figures/{p.name}" for p in folder.glob("figures/*.png")]]
    show(output, summary, summary_table(summary), *(f" {folder / file}" for file in files))
