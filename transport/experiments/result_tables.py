"""Tables of results, for the console and in Markdown: columns by the kind of experiment, means with their spread."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.table import Table

from transport.experiments.statistics import (
    COST_RATIO,
    FEW,
    FIRST_DIVERGED,
    WORST_ATTITUDE,
    PointStatistics,
    with_spread,
)
from transport.flight.run_files import machine
from transport.protocol.scenario.files.atomic_writing import write_whole

# Most characters in a line of a table.
WIDTH = 160
SPREAD = f"± half the 95 % interval; range of fewer than {FEW} runs"
TITLE = f"means of completed runs, {SPREAD}"

# Numbers from here on are shown without decimals.
_LARGE = 100.0


class Column(NamedTuple):
    """A column of the console's table."""

    heading: str
    name: str  # of the number
    factor: float = 1.0
    digits: int = 2
    interval: bool = False  # whether confidence intervals are shown

    def cell(self, row: Mapping[str, Any]) -> str:
        """Return the number of a row as text."""
        mean = row.get(self.name)
        if mean is None:
            return "-"
        half_width, low, high = (
            row.get(f"{self.name}_{ending}") if self.interval else None
            for ending in ("ci95", "min", "max")
        )
        values = {"mean": mean, "half_width": half_width, "low": low, "high": high}
        return with_spread({**values, "n": row.get("completed")}, self._text)

    def _text(self, value: float) -> str:
        """Return a number in the unit of the column, a large one without decimals."""
        shown = self.factor * value
        digits = self.digits if abs(shown) < _LARGE else 0
        return f"{shown:.{digits}f}"


_DIVERGED = Column("div.\n(s)", FIRST_DIVERGED, 1.0, 1)
_COST = Column("cost mean\n(1e-3)", "cost_mean", 1e3, 2, True)
_RATIO = Column("cost\nratio", COST_RATIO)
_ATTITUDE = Column("attitude\n(deg)", "attitude_max_deg", 1.0, 2, True)
_SWING = Column("swing\n(m)", "swing_m")
_APART = Column("apart\n(m)", "separation_min_m", 1.0, 3)
_AGE = Column("age\n(tick)", "plan_age_mean_ticks")
_ERROR = Column("error rms\n(cm)", "payload_rms_m", 100.0, 2, True)
_LARGEST_ERROR = Column("largest\n(cm)", "payload_max_m", 100.0, 1)
_COLUMNS = [
    _DIVERGED,
    _COST,
    _RATIO,
    Column("max\n(1e-3)", "cost_max", 1e3, 1),
    _ATTITUDE,
    _SWING,
    _APART,
    _AGE,
]

_WORST_ATTITUDE = Column("worst\n(deg)", WORST_ATTITUDE, 1.0, 1)

# Columns in place of `_COLUMNS`, by the label of the points that selects them; the first label counts.
_FURTHER = {
    "weather": [
        *(_DIVERGED, _ERROR, _LARGEST_ERROR),
        *(_COST, _RATIO, _ATTITUDE, _APART, _AGE),
    ],
    "rule": [
        Column("away rms\n(cm)", "away_rms_m", 100.0, 1, True),
        Column("known\n(s)", "known_s"),
        *(_DIVERGED, _ERROR, _ATTITUDE, _WORST_ATTITUDE, _APART),
    ],
    "age_s": [
        *(_ERROR, _LARGEST_ERROR),
        *(_DIVERGED, _RATIO, _ATTITUDE, _WORST_ATTITUDE, _APART, _AGE),
    ],
    "share_threshold": [
        Column("plans\nsent (%)", "plans_shared_share", 100.0, 1, True),
        *(_COST, _RATIO, _ATTITUDE, _AGE),
    ],
    "speed_mps": [
        *(_ERROR, _LARGEST_ERROR),
        *(_DIVERGED, _RATIO, _ATTITUDE, _APART, _AGE),
    ],
    "ownership": [
        Column("CPU step\np50 (ms)", "cpu_step_p50_ms", 1.0, 2, True),
        Column("p99\n(ms)", "cpu_step_p99_ms"),
        Column("team\n(ms)", "cpu_team_tick_ms", 1.0, 1),
        Column("plans\n(kB/s)", "plan_bytes_per_s", 1e-3, 1),
        *(_COST, _RATIO, _SWING),
    ],
}


def table_of(title: str, measured: Sequence[PointStatistics]) -> Table:
    """Return the table for the console; its further columns are those of the first label that has some."""
    names = list(measured[0].point.labels)
    columns = next((_FURTHER[name] for name in names if name in _FURTHER), _COLUMNS)
    headings = {name: name.replace("_", "\n", 1) for name in ("scenario", *names)}
    return console_table(title, headings, columns, [m.row() for m in measured])


def console_table(
    title: str,
    labels: Mapping[str, str],
    columns: Sequence[Column],
    rows: Sequence[Mapping[str, Any]],
) -> Table:
    """Return a table for the console.

    It has labels with their headings, the number of completed runs, and columns of numbers.
    """
    table = Table(
        box=None, title=title, title_justify="left", title_style="bold", padding=(0, 1, 0, 0)
    )
    for heading in labels.values():
        table.add_column(heading, no_wrap=True)
    for heading in ("done", *(column.heading for column in columns)):
        table.add_column(heading, justify="right", no_wrap=True)

    for row in rows:
        values = [row[name] for name in labels]
        texts = [value if isinstance(value, str) else f"{value:g}" for value in values]
        errors = f" {row['errors']}!" if row.get("errors") else ""
        done = f"{row['completed']}/{row['flights']}{errors}"
        table.add_row(*texts, done, *(column.cell(row) for column in columns))
    return table


def markdown_of(table: Table) -> list[str]:
    """Return the lines of a table in Markdown; a line break within a cell stays one."""
    headings = [" ".join(str(column.header).split()) for column in table.columns]
    rows = zip(*(column.cells for column in table.columns), strict=True)
    texts = [[str(cell).replace("\n", "<br>") for cell in row] for row in rows]
    cells = [headings, ["---"] * len(headings), *texts]
    return [f"| {' | '.join(row)} |" for row in cells]


def write_markdown(
    folder: Path, sentences: Sequence[str], table: Table, files: Sequence[Path]
) -> list[str]:
    """Write sentences, table and machine to report.md.

    Returns: Lines for the console, with the files.
    """
    file = folder / "report.md"
    origin = f"machine: {machine()}"
    text = f"{markdown(sentences, table)}\n*{origin}*\n"
    write_whole(file, text.encode())
    return ["", *sentences, "", origin, *(f" {path}" for path in (*files, file))]


def markdown(sentences: Sequence[str], table: Table) -> str:
    """Return sentences and table as Markdown, which ends with a line end."""
    return "\n".join([*(f"- {sentence}" for sentence in sentences), "", *markdown_of(table), ""])
