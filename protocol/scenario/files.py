"""Files that a scenario names: tables of paths and of measured delays.

The table of a path becomes part of the scenario when that is read: it is in the fingerprint that the processes of a run
compare, and in the run folder, without the file.
"""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from protocol.wire.errors import TransportError

COLUMNS = "t_s,x_m,y_m,z_m"


class TableError(TransportError, ValueError):
    """An invalid file of a scenario: the text has the row, counted from 1 below the heading, expected and got."""


def anchored(value: Any, here: Path, folder: Path | None = None, key: str = "") -> Any:
    """Return part of a scenario's tree, whose files are relative to the folder `here`, for a scenario in `folder`.

    Files below `folder` are named relative to it, others by their absolute paths, as are all without a folder.
    """
    if isinstance(value, list):
        return [anchored(entry, here, folder, key) for entry in value]
    if isinstance(value, dict):
        return {name: anchored(entry, here, folder, name) for name, entry in value.items()}
    if key in ("samples", "file") and isinstance(value, str):
        # Without following links: a name stays as the user knows it.
        path, own = Path(os.path.abspath(here / value)), Path(os.path.abspath(folder or here))  # noqa: PTH100
        return str(path.relative_to(own) if folder and path.is_relative_to(own) else path)
    return value


def delays_of(path: Path) -> tuple[float, ...]:
    """Return the measured delays in a file, s, in ascending order.

    Raises: TableError: it cannot be read, or has other content.
    """
    try:
        values = [float(word) for word in _text(path).replace(",", " ").split()]
    except ValueError as error:
        raise TableError(f"{path}: expected delays in seconds, {error}") from error
    if not values or not all(0.0 <= value < math.inf for value in values):
        raise TableError(f"{path}: expected delays >= 0 s, got {values[:3]}")
    return tuple(sorted(values))


def way_of(path: Path) -> list[list[float]]:
    """Return the path in a CSV file with `COLUMNS` as rows of time and position, both relative to the first row.

    Raises: TableError: it cannot be read, or is invalid.
    """
    _, rows = _table(path, COLUMNS)
    return [[value - first for value, first in zip(row, rows[0], strict=True)] for row in rows]


def points_of(path: Path) -> tuple[list[list[float]], list[float] | None]:
    """Return the way points in a CSV file, m, and their times, s, if it has any.

    Its heading is x,y,z or t,x,y,z, each perhaps with its unit, as in `COLUMNS`.

    Raises: TableError: it cannot be read, or is invalid.
    """
    columns, rows = _table(path, "x,y,z", "t,x,y,z", "x_m,y_m,z_m", COLUMNS)
    return [row[-3:] for row in rows], [row[0] for row in rows] if columns.startswith("t") else None


def _table(path: Path, *headings: str) -> tuple[str, list[list[float]]]:
    """Return the heading of a CSV file, one of those given, and its rows of numbers, at least one."""
    heading, *lines = _text(path).splitlines() or [""]
    columns = heading.replace(" ", "")
    if columns not in headings:
        raise TableError(f"{path}: expected the heading {' or '.join(headings)}, got {heading[:60]!r}")
    rows = []
    for number, line in enumerate(filter(str.strip, lines), start=1):
        try:
            rows.append([float(word) for word in line.split(",")])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != columns.count(",") + 1 or not all(map(math.isfinite, rows[-1])):
            raise TableError(f"{path}: row {number}: expected finite numbers {columns}, got {line[:60]!r}")
    if not rows:
        raise TableError(f"{path}: expected rows below the heading, got none")
    return columns, rows


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise TableError(f"cannot read {path} ({getattr(error, 'strerror', '') or error})") from error


def write_delays(samples_s: Mapping[str, Sequence[float]], folder: Path) -> None:
    """Write the delays, s, of the files that a scenario in a folder names, unless their paths are absolute."""
    for name, delays_s in samples_s.items():
        if not Path(name).is_absolute():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text("\n".join(map(repr, delays_s)) + "\n", encoding="utf-8")
