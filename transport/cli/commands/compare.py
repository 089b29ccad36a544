"""Command `transport compare`: recorded runs in a table and in figures."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import typer
from typer import Argument, Option

from transport.cli.options import FiguresOption, FormatOption, complete_run, newest_runs, run_folder
from transport.cli.output import Format, blame, fail, rows, show
from transport.log.run_folder import new_folder, open_run
from transport.protocol.scenario.files.atomic_writing import write_csv
from transport.report.overlaid_runs import draw_compared
from transport.report.run_comparison import ComparedRun, Row, Setting, doubts, settings_apart
from transport.report.run_comparison import rows as quantities

# Heading of the settings that differ, how many are shown, and characters of a value.
_SETTINGS = "settings that differ"
_MOST_SETTINGS, _LONGEST_SHOWN = 20, 20


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

    Differences are relative to the first run, in percent. Notes on standard error name the
    differences that make runs hard to compare: another maneuver, other weights, a truncated log.

    Example: transport compare paper=runs/20260102-101500-paper resilient=runs/20260102-101600-resilient
    """
    compared = _chosen(runs or [])
    labels = [one.label for one in compared]
    table = quantities(compared)
    notes = list(doubts(compared))

    folder = out or new_folder(Path("comparisons"), f"{len(compared)}-runs")
    with blame("--out"):
        folder.mkdir(parents=True, exist_ok=True)
        files = [_written(folder / "compare.csv", labels, table)]
        if figures:
            files += draw_compared(compared, folder)

    for note in notes:
        typer.echo(f"note: {note}", err=True)
    apart = settings_apart(compared)
    content = {
        "runs": [{"label": one.label, "folder": str(one.run.folder)} for one in compared],
        "quantities": [row._asdict() for row in table],
        "settings": [setting._asdict() for setting in apart],
        "notes": notes,
        "files": [str(file) for file in files],
    }
    shown = [_in_words(row, labels) for row in table]
    settings = _table_of_settings(apart, labels)
    show(output, content, rows(shown, ""), *settings, *(f" {file}" for file in files))


def _chosen(runs: Sequence[str]) -> list[ComparedRun]:
    """Return the runs that are compared.

    End the command if there are not two with labels of their own.
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
    return compared


def _written(path: Path, labels: Sequence[str], table: Sequence[Row]) -> Path:
    """Write a table with the values and the differences of all runs; return its path."""
    differences = [f"{label}, more than {labels[0]} (%)" for label in labels[1:]]
    columns = ["quantity", "unit", *labels, *differences]
    lines = [(row.name, row.unit, *row.values, *row.percent[1:]) for row in table]
    write_csv(path, [dict(zip(columns, line, strict=True)) for line in lines], columns)
    return path


def _in_words(row: Row, labels: Sequence[str]) -> dict[str, Any]:
    """Return a line of the table on the console: values, and differences from the first run."""
    line: dict[str, Any] = {"": f"{row.name} ({row.unit})" if row.unit else row.name}
    runs = zip(labels, row.values, row.percent, strict=True)
    for i, (label, value, percent) in enumerate(runs):
        line[label] = value
        if i > 0 and percent is not None:
            difference = "=" if percent == 0.0 else f"{percent:+.1f}%"
            if difference in ("+0.0%", "-0.0%"):
                difference = "0.0%"
            line[label] = f"{value:.4g}  {difference:>7}"
    return line


def _table_of_settings(apart: Sequence[Setting], labels: Sequence[str]) -> Iterator[Any]:
    """Yield the table of the first settings that differ, and how many there are beyond it."""
    if apart:
        yield ""
        yield rows([_setting_in_words(one, labels) for one in apart[:_MOST_SETTINGS]], _SETTINGS)
    if len(apart) > _MOST_SETTINGS:
        yield f" and {len(apart) - _MOST_SETTINGS} more settings"


def _setting_in_words(setting: Setting, labels: Sequence[str]) -> dict[str, str]:
    """Return a line of the table of settings that differ."""
    values = map(_shortly, setting.values)
    return {_SETTINGS: setting.key, **dict(zip(labels, values, strict=True))}


def _shortly(value: Any) -> str:
    """Return a value of a scenario in few words."""
    if value is None or value == []:
        return "-"
    if isinstance(value, list) and any(isinstance(entry, list | dict) for entry in value):
        return f"{len(value)} entries"
    text = str(value)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."


def _read(arguments: Sequence[str]) -> Iterator[ComparedRun]:
    """Yield the runs of arguments RUN or LABEL=RUN."""
    for argument in arguments:
        label, equals, path = argument.partition("=")
        # The name of a folder may contain an equals sign.
        if not equals or Path(argument).exists():
            label = ""
            path = argument
        folder = run_folder(Path(path))
        yield ComparedRun.of(label or folder.resolve().name, open_run(folder, horizons=False))
