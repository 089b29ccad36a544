"""The command `transport compare`."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import typer
from typer import Argument, Option

from transport.cli.options import FiguresOption, FormatOption, complete_run, newest_runs, run_folder
from transport.cli.output import Format, blame, fail, rows, show
from transport.flight.run_files import new_folder
from transport.log.run_log import open_run
from transport.report.compare import Compared, doubts, draw_compared
from transport.report.compare import rows as quantities
from transport.report.report import write_csv


def compare(
    runs: list[str] | None = Argument(
        None,
        metavar="RUN",
        help="Run folders or names in runs/, by default the two most recent; LABEL=RUN names one.",
        autocompletion=complete_run,
    ),
    out: Path | None = Option(
        None, metavar="FOLDER", help="Folder to write; by default comparisons/<time>-<runs>."
    ),
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
        fail(f"RUN: expected at least two runs, got {len(chosen)}")
    compared = list(_read(chosen))
    usable = sum(len(one.series.ticks) > 0 for one in compared)
    if usable < 2:
        fail(f"expected at least two logs with a simulated tick, got {usable} of {len(compared)}")
    labels = [one.label for one in compared]
    if len(set(labels)) < len(labels):
        fail(f"RUN: expected each label once, got {', '.join(labels)}; LABEL=RUN names one")
    table, notes = quantities(compared), list(doubts(compared))
    folder = out or new_folder(Path("comparisons"), f"{len(compared)}-runs")
    columns = [
        "quantity",
        "unit",
        *labels,
        *(f"{label}, more than {labels[0]} (%)" for label in labels[1:]),
    ]
    lines = ((row.name, row.unit, *row.values, *row.percent[1:]) for row in table)
    with blame("--out"):
        folder.mkdir(parents=True, exist_ok=True)
        write_csv(
            folder / "compare.csv",
            (dict(zip(columns, line, strict=True)) for line in lines),
            columns,
        )
        files = [folder / "compare.csv", *(draw_compared(compared, folder) if figures else ())]
    for note in notes:
        typer.echo(f"note: {note}", err=True)
    content = {
        "runs": [{"label": one.label, "folder": str(one.run.folder)} for one in compared],
        "quantities": [row._asdict() for row in table],
        "notes": notes,
        "files": [str(file) for file in files],
    }
    shown: list[dict[str, Any]] = [
        {"": f"{row.name} ({row.unit})" if row.unit else row.name}
        | {
            label: value
            if i == 0 or percent is None
            else f"{value:.4g}  {f'{percent:+.1f}%' if percent else '=':>7}"
            for i, (label, value, percent) in enumerate(
                zip(labels, row.values, row.percent, strict=True)
            )
        }
        for row in table
    ]
    show(output, content, rows(shown, ""), *(f" {file}" for file in files))


def _read(arguments: Sequence[str]) -> Iterator[Compared]:
    for argument in arguments:
        name, equals, path = argument.partition("=")
        # The name of a folder may contain an equals sign.
        label, given = (name, path) if equals and not Path(argument).exists() else ("", argument)
        folder = run_folder(Path(given))
        yield Compared.of(label or folder.resolve().name, open_run(folder, horizons=False))
