"""Files that a scenario names: tables of paths and of measured delays.

The table of a path becomes part of the scenario when that is read, so of its fingerprint and of the run folder.
"""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from protocol.wire.errors import TransportError

COLUMNS = "t_s,x_m,y_m,z_m"


class TableError(TransportError, ValueError):
    """An invalid file of a scenario: the text has file, expected and got."""


def anchored(value: Any, here: Path, folder: Path | None = None, key: str = "") -> Any:
    """Return a part of a scenario's tree, whose files are relative to the folder `here`, for a scenario in `folder`.

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
    """Return the measured delays in a file, s, in ascending order. Raises: TableError: it is invalid."""
    try:
        values = [float(word) for word in path.read_text(encoding="utf-8").replace(",", " ").split()]
    except (OSError, ValueError) as error:
        raise TableError(f"{path}: expected delays in seconds ({error})") from error
    if not values or not all(0.0 <= value < math.inf for value in values):
        raise TableError(f"{path}: expected delays >= 0 s, got {values[:3]}")
    return tuple(sorted(values))


def way_of(path: Path) -> list[list[float]]:
    """Return rows of time and position, relative to the first, of a CSV file with `COLUMNS`. Raises: TableError."""
    _, rows = _table(path, COLUMNS)
    return [[value - first for value, first in zip(row, rows[0], strict=True)] for row in rows]


def points_of(path: Path) -> tuple[list[list[float]], list[float] | None]:
    """Return way points, m, and any times, s, of a CSV file with columns x,y,z or t,x,y,z. Raises: TableError."""
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
        raise TableError(f"cannot read {path} ({getattr(error, 'strerror', '') or error})") from error
    return columns, rows.tolist()


def write_delays(samples_s: Mapping[str, Sequence[float]], folder: Path) -> None:
    """Write the delays, s, of the files that a scenario in a folder names, unless their paths are absolute."""
    for name, delays_s in samples_s.items():
        if not Path(name).is_absolute():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text("\n".join(map(repr, delays_s)) + "\n", encoding="utf-8")
