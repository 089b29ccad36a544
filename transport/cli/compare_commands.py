"""The command `transport compare`."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_USAGE
from transport.cli.answers import Format, fail, show_json

if TYPE_CHECKING:
    from transport.report.compare import Compared, Row


def compare(
    runs: Annotated[
        list[str], typer.Argument(metavar="RUN RUN...", help="Run folders; LABEL=RUN gives one a name of its own.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for figures and table; by default comparisons/<time>-<runs>.")
    ] = None,
    figures: Annotated[bool, typer.Option("--figures/--no-figures", help="Draw the figures.")] = True,
    output: Annotated[Format, typer.Option("--format", help="What goes to standard output.")] = Format.text,
) -> None:
    """Lay recorded runs side by side, in a table and in figures.

    The first is what the others are compared with, in percent. What makes them hard to compare (another maneuver,
    other weights, a log that was cut) is said on standard error.

    Example: transport compare paper=runs/20260102-101500-paper resilient=runs/20260102-101600-resilient
    """
    from transport.report.compare import doubts, rows

    if len(runs) < 2:
        fail(f"expected at least two runs, got {len(runs)}", EXIT_USAGE)
    compared = _read(runs)
    flown = sum(len(one.series.ticks) > 0 for one in compared)
    if flown < 2:
        fail(f"nothing to compare: {flown} of {len(compared)} logs hold a tick that was flown", EXIT_USAGE)
    table = rows(compared)
    remarks = list(doubts(compared))
    files = _files(compared, table, out, figures=figures)
    for remark in remarks:
        typer.echo(f"note: {remark}", err=True)
    if output is Format.json:
        show_json(_content(compared, table, remarks, files))
        return
    _show(compared, table)
    for file in files:
        typer.echo(f" {file}")


def _read(arguments: Sequence[str]) -> "list[Compared]":
    from protocol.scenario.file import ScenarioError
    from transport.log.run_folder import open_run
    from transport.log.run_log import LogError
    from transport.report.compare import Compared

    named: list[tuple[str | None, Path]] = []
    for argument in arguments:
        name, equals, path = argument.partition("=")
        # A folder may have an equals sign in its name.
        named.append((name, Path(path)) if equals and not Path(argument).exists() else (None, Path(argument)))
    names = [folder.resolve().name for _, folder in named]
    found = []
    for i, (label, folder) in enumerate(named):
        # Folders of the same name are told apart by their place in the command.
        usual = names[i] if names.count(names[i]) == 1 else f"{names[i]} ({i + 1})"
        try:
            found.append(Compared.of(label or usual, open_run(folder, horizons=False)))
        except LogError as error:
            fail(str(error), EXIT_USAGE)
        except ScenarioError as error:
            fail(str(error), EXIT_SCENARIO)
    return found


def _files(compared: "Sequence[Compared]", table: "Sequence[Row]", out: Path | None, *, figures: bool) -> list[Path]:
    from transport.flight.run import new_folder
    from transport.report.report import write_whole

    folder = out or new_folder(Path("comparisons"), f"{len(compared)}-runs")
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    labels = [one.label for one in compared]
    header: list[str] = ["quantity", "unit", *labels, *(f"{label}, more than {labels[0]} (%)" for label in labels[1:])]
    writer.writerow(header)
    for row in table:
        writer.writerow([row.name, row.unit, *row.values, *row.percent[1:]])
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "compare.csv", text.getvalue().encode())
        if not figures:
            return [folder / "compare.csv"]
        from transport.report.compare_figure import draw_compared

        return [folder / "compare.csv", *draw_compared(compared, folder)]
    except OSError as error:
        fail(f"--out: cannot write to {folder} ({error.strerror or error})", EXIT_USAGE)


def _show(compared: "Sequence[Compared]", table: "Sequence[Row]") -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    shown = Table(box=None)
    shown.add_column("", style="cyan", no_wrap=True)
    for one in compared:
        shown.add_column(Text(one.label, "bold"), justify="right")
    for row in table:
        name = f"{row.name} ({row.unit})" if row.unit else row.name
        cells = [_cell(value, percent) for value, percent in zip(row.values, row.percent, strict=True)]
        cells[0] = _cell(row.values[0], None)
        shown.add_row(name, *cells)
    Console().print(shown)


def _cell(value: Any, percent: float | None) -> str:
    text = "-" if value is None else value if isinstance(value, str) else f"{value:.4g}"
    if percent is None:
        return text
    return f"{text}  {'=' if percent == 0.0 else f'{percent:+.1f}%':>7}"


def _content(
    compared: "Sequence[Compared]", table: "Sequence[Row]", remarks: Sequence[str], files: Sequence[Path]
) -> dict[str, Any]:
    return {
        "runs": [{"label": one.label, "folder": str(one.run.folder)} for one in compared],
        "quantities": [
            {"name": row.name, "unit": row.unit, "values": row.values, "percent_more_than_first": row.percent}
            for row in table
        ],
        "notes": remarks,
        "files": [str(file) for file in files],
    }
