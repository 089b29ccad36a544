"""The report of a recorded run: summary and figures in its folder, the summary on standard output."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import orjson
import typer
from rich.console import Console

from protocol.scenario.file import ScenarioError
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_UNRECORDED, EXIT_USAGE
from transport.cli.output import Format, exit_on, fail, show_json
from transport.log.run_log import LogError
from transport.report.report import summary_table, warnings, write_report


def report(folder: Path, output: Format, *, figures: bool, setup: Setup | None) -> None:
    """Write the report of a run folder and print its summary; without a setup it is read from the folder."""
    with exit_on(LogError, code=EXIT_USAGE), exit_on(ScenarioError, code=EXIT_SCENARIO):
        try:
            summary = write_report(folder, figures=figures, setup=setup)
        except OSError as error:
            fail(f"{folder}: cannot write the report ({error.strerror or error})", EXIT_UNRECORDED)
    show(folder, output, summary)


def show_written(folder: Path, output: Format) -> None:
    """Print the summary in a run folder."""
    show(folder, output, orjson.loads((folder / "summary.json").read_bytes()))


def show(folder: Path, output: Format, summary: Mapping[str, Any]) -> None:
    """Print a summary and the files of its run folder."""
    for warning in warnings(summary):
        typer.echo(f"warning: {warning}", err=True)
    if output is Format.json:
        show_json(summary)
        return
    Console().print(summary_table(summary))
    for file in ["summary.json", "steps.csv", "run.mcap", *[f"figures/{p.name}" for p in folder.glob("figures/*.png")]]:
        typer.echo(f" {folder / file}")
