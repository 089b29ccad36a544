"""Files that a scenario names, tables of paths and of measured delays, which become part of it when it is read."""

from pathlib import Path
from typing import Any

import numpy as np

from transport.protocol.wire.errors import TransportError


class TableError(TransportError, ValueError):
    """An invalid file of a scenario: the text has file, expected and got."""


def anchored(value: Any, key: str) -> Any:
    """Return a part of a scenario's tree whose files are relative to the current folder, with their absolute paths."""
    if isinstance(value, list):
        return [anchored(entry, key) for entry in value]
    if isinstance(value, dict):
        return {name: anchored(entry, name) for name, entry in value.items()}
    return (
        str(Path.cwd() / value) if key in ("samples", "file") and isinstance(value, str) else value
    )


def delays_of(path: Path) -> list[float]:
    """Return the measured delays in a file, s, in ascending order.

    Raises: TableError: it cannot be read.
    """
    try:
        return sorted(map(float, path.read_text(encoding="utf-8").replace(",", " ").split()))
    except (OSError, ValueError) as error:
        raise TableError(f"{path}: expected delays in seconds ({error})") from error


def way_of(path: Path) -> list[list[float]]:
    """Return rows of time and position, relative to the first, of a CSV file. Raises: TableError."""
    _, rows = _table(path, "t_s,x_m,y_m,z_m")
    return [[value - first for value, first in zip(row, rows[0], strict=True)] for row in rows]


def points_of(path: Path) -> tuple[list[list[float]], list[float] | None]:
    """Return way points, m, and any times, s, of a CSV file with columns x,y,z or t,x,y,z.

    Raises: TableError.
    """
    columns, rows = _table(path, "x,y,z", "t,x,y,z")
    return [row[-3:] for row in rows], [row[0] for row in rows] if columns.startswith("t") else None


def _table(path: Path, *headings: str) -> tuple[str, list[list[float]]]:
    """Return the heading of a CSV file, one of those given, and its rows of numbers, at least one."""
    try:
        columns, *lines = path.read_text(encoding="utf-8").replace(" ", "").splitlines() or [""]
        if columns not in headings:
            raise ValueError(f"expected the heading {' or '.join(headings)}, got {columns[:60]!r}")
        rows = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.zeros((0, 0))
        if rows.shape[1] != columns.count(",") + 1 or not np.isfinite(rows).all():
            raise ValueError(f"expected rows of finite numbers {columns}")
    except (OSError, ValueError) as error:
        raise TableError(
            f"cannot read {path} ({getattr(error, 'strerror', '') or error})"
        ) from error
    return columns, rows.tolist()
