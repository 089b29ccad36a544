"""Files that a scenario names: tables of paths, of measured delays and of recorded links.

Their content becomes part of the scenario when it is read.
"""

import math
import re
from pathlib import Path
from typing import Any

from transport.protocol.scenario.files.bounded_reading import read_text
from transport.protocol.wire.errors_and_exit_codes import TransportError

# Keys whose text is a file.
_FILE_KEYS = ("samples_s", "trace", "file")

# Whole numbers joined by commas: one number with a decimal comma, perhaps with an exponent, or several.
_DECIMAL_COMMA = re.compile(r"[+-]?\d+(,\d+)+([eE][+-]?\d+)?")

_LONGEST_SHOWN = 60  # characters of a file that an error repeats

LOST_S = -1.0  # delay of a lost message in a trace


class TableError(TransportError, ValueError):
    """An invalid file of a scenario: the text has file, row, column, expected and got."""


def anchored(value: Any, key: str) -> Any:
    """Return a value of a setting with absolute paths of its files, from the current folder."""
    if isinstance(value, list):
        return [anchored(entry, key) for entry in value]
    if isinstance(value, dict):
        return {name: anchored(entry, name) for name, entry in value.items()}
    if isinstance(value, str) and key in _FILE_KEYS:
        return str(Path.cwd() / value)
    return value


def delays_of(path: Path) -> list[float]:
    """Return the measured delays in a file, s, in ascending order.

    Raises: TableError: it cannot be read.
    """
    delays_s: list[float] = []
    for row, line in enumerate(_lines(path), start=1):
        for word in line.split():
            entries = word.strip(",")
            if _DECIMAL_COMMA.fullmatch(entries):
                expected = (
                    "expected delays in seconds with a decimal point, separated by blanks or lines"
                )
                raise TableError(f"{path}: row {row}: {expected}, got {_shown(entries)}")
            delays_s += [_number(text, path, f"row {row}") for text in entries.split(",") if text]
    return sorted(delays_s)


def trace_of(path: Path) -> list[list[float]]:
    """Return times and delays of a recorded link, s, a negative delay for a lost message.

    A CSV file with the columns t_s,delay_s, whose second one may be `lost`.

    Raises: TableError: it cannot be read.
    """
    columns, lines = _heading_and_lines(path, "t_s,delay_s")
    rows: list[list[float]] = []
    for number, line in lines:
        cells = _cells(line, columns, path, number)
        if cells[1].strip() == "lost":
            cells[1] = str(LOST_S)
        rows.append(_numbers(cells, columns, path, number))
    return rows


def way_of(path: Path) -> list[list[float]]:
    """Return rows of time and position, relative to the first, of a CSV file.

    Raises: TableError: it cannot be read.
    """
    _, rows = _table(path, "t_s,x_m,y_m,z_m")
    return [[value - first for value, first in zip(row, rows[0], strict=True)] for row in rows]


def points_of(path: Path) -> tuple[list[list[float]], list[float] | None]:
    """Return way points, m, and any times, s, of a CSV file with columns x,y,z or t,x,y,z.

    Raises: TableError: it cannot be read.
    """
    columns, rows = _table(path, "x,y,z", "t,x,y,z")
    points_m = [row[-3:] for row in rows]
    times_s = [row[0] for row in rows] if columns[0] == "t" else None
    return points_m, times_s


def _table(path: Path, *headings: str) -> tuple[list[str], list[list[float]]]:
    """Return the columns of a CSV file, one of the headings, and its rows, at least one."""
    columns, lines = _heading_and_lines(path, *headings)
    rows: list[list[float]] = []
    for number, line in lines:
        cells = _cells(line, columns, path, number)
        rows.append(_numbers(cells, columns, path, number))
    if not rows:
        expected = f"expected rows of numbers {','.join(columns)}"
        raise TableError(f"cannot read {path} ({expected}, got none)")
    return columns, rows


def _heading_and_lines(path: Path, *headings: str) -> tuple[list[str], list[tuple[int, str]]]:
    """Return the columns of a CSV file, one of the headings, and its other lines with numbers."""
    first, *lines = _lines(path) or [""]
    heading = first.replace(" ", "")
    if heading not in headings:
        expected = f"expected the heading {' or '.join(headings)}"
        raise TableError(f"cannot read {path} ({expected}, got {_shown(heading)})")

    numbered = enumerate(lines, start=2)  # the heading is row 1, as in a spreadsheet
    return heading.split(","), [(number, line) for number, line in numbered if line.strip()]


def _cells(line: str, columns: list[str], path: Path, number: int) -> list[str]:
    """Return the texts in one row of a table, one for each column."""
    cells = line.split(",")
    if len(cells) != len(columns):
        expected = f"row {number}: expected {len(columns)} numbers {','.join(columns)}"
        raise TableError(f"{path}: {expected}, got {len(cells)} cells {_shown(line)}")
    return cells


def _numbers(cells: list[str], columns: list[str], path: Path, number: int) -> list[float]:
    """Return the numbers in the cells of one row of a table."""
    return [
        _number(cell, path, f"row {number}, column {column}")
        for cell, column in zip(cells, columns, strict=True)
    ]


def _number(text: str, path: Path, place: str) -> float:
    """Return the finite number in a cell."""
    try:
        number = float(text) if "_" not in text else math.nan  # Python's own notation
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise TableError(f"{path}: {place}: expected a finite number, got {_shown(text)}")
    return number


def _lines(path: Path) -> list[str]:
    """Return the lines of a text file."""
    try:
        return read_text(path).splitlines()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise TableError(f"cannot read {path} ({reason})") from error


def _shown(text: str) -> str:
    """Return a text of a file as an error shows it."""
    stripped = text.strip()
    return repr(stripped[:_LONGEST_SHOWN]) if stripped else "nothing"
