"""The command `transport compare`."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer import Argument, Option

from protocol.scenario.file import ScenarioError
from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_USAGE
from transport.cli.options import FiguresOption, FormatOption
from transport.cli.output import Format, exit_on, fail, show_json
from transport.cli.recorded_run import complete_run, newest_runs, run_folder
from transport.flight.run_files import new_folder
from transport.log.run_folder import open_run
from transport.log.run_log import LogError
from transport.report.compare import Compared, Row, doubts, draw_compared, rows
from transport.report.report import write_whole


def compare(
    runs: Annotated[
        list[str] | None,
        Argument(
            metavar="RUN",
            help="Run folders or names in runs/, by default the two most recent; LABEL=RUN names one.",
            autocompletion=complete_run,
        ),
    ] = None,
    out: Annotated[
        Path | None, Option("--out", metavar="FOLDER", help="Folder to write; by default comparisons/<time>-<runs>.")
    ] = None,
    figures: FiguresOption = True,
    output: FormatOption = Format.text,
) -> None:
    """Compare recorded runs in a table and in figures.

    Differences are relative to the first run, in percent. Notes on standard error name the differences that make runs
    hard to compare: another maneuver, other weights, a truncated log.

    Example: transport compare paper=runs/20260102-101500-paper resilient=runs/20260102-101600-resilient
    """
    chosen = runs or [str(folder) for folder in reversed(newest_runs()[:2])]
    if len(chosen) < 2:
        fail(f"RUN: expected at least two runs, got {len(chosen)}", EXIT_USAGE)
    compared = _read(chosen)
    usable = sum(len(one.series.ticks) > 0 for one in compared)
    if usable < 2:
        fail(f"expected at least two logs with a simulated tick, got {usable} of {len(compared)}", EXIT_USAGE)
    table = rows(compared)
    notes = list(doubts(compared))
    files = _write(compared, table, out, figures=figures)
    for note in notes:
        typer.echo(f"note: {note}", err=True)
    if output is Format.json:
        show_json(_content(compared, table, notes, files))
        return
    _show(compared, table)
    for file in files:
        typer.echo(f" {file}")


def _read(arguments: Sequence[str]) -> list[Compared]:
    named: list[tuple[str | None, Path]] = []
    for argument in arguments:
        name, equals, path = argument.partition("=")
        # The name of a folder may contain an equals sign.
        label, given = (name, path) if equals and not Path(argument).exists() else (None, argument)
        named.append((label, run_folder(Path(given))))
    names = [folder.resolve().name for _, folder in named]
    found = []
    for i, (label, folder) in enumerate(named):
        # Folders of the same name are told apart by their place in the command.
        default = names[i] if names.count(names[i]) == 1 else f"{names[i]} ({i + 1})"
        with exit_on(LogError, code=EXIT_USAGE), exit_on(ScenarioError, code=EXIT_SCENARIO):
            found.append(Compared.of(label or default, open_run(folder, horizons=False)))
    return found


def _write(compared: Sequence[Compared], table: Sequence[Row], out: Path | None, *, figures: bool) -> list[Path]:
    """Write table and figures; return their files."""
    folder = out or new_folder(Path("comparisons"), f"{len(compared)}-runs")
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    labels = [one.label for one in compared]
    writer.writerow(["quantity", "unit", *labels, *(f"{label}, more than {labels[0]} (%)" for label in labels[1:])])
    for row in table:
        writer.writerow([row.name, row.unit, *row.values, *row.percent[1:]])
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "compare.csv", text.getvalue().encode())
        return [folder / "compare.csv", *(draw_compared(compared, folder) if figures else ())]
    except OSError as error:
        fail(f"--out: cannot write to {folder} ({error.strerror or error})", EXIT_USAGE)


def _show(compared: Sequence[Compared], table: Sequence[Row]) -> None:
    shown = Table(box=None)
    shown.add_column("", style="cyan", no_wrap=True)
    for one in compared:
        shown.add_column(Text(one.label, "bold"), justify="right")
    for row in table:
        name = f"{row.name} ({row.unit})" if row.unit else row.name
        others = zip(row.values[1:], row.percent[1:], strict=True)
        shown.add_row(name, _cell(row.values[0], None), *(_cell(value, percent) for value, percent in others))
    Console().print(shown)


def _cell(value: Any, percent: float | None) -> str:
    text = "-" if value is None else value if isinstance(value, str) else f"{value:.4g}"
    if percent is None:
        return text
    return f"{text}  {'=' if percent == 0.0 else f'{percent:+.1f}%':>7}"


def _content(
    compared: Sequence[Compared], table: Sequence[Row], notes: Sequence[str], files: Sequence[Path]
) -> dict[str, Any]:
    return {
        "runs": [{"label": one.label, "folder": str(one.run.folder)} for one in compared],
        "quantities": [
            {"name": row.name, "unit": row.unit, "values": row.values, "percent_more_than_first": row.percent}
            for row in table
        ],
        "notes": notes,
        "files": [str(file) for file in files],
    }
