"""Paths from files: a table of times and positions in place of a straight phase of the maneuver.

The table becomes part of the scenario when that is read: it is in the fingerprint that the processes of a run compare,
and in the run folder, without the file.
"""

import math
from pathlib import Path
from typing import Any

from protocol.scenario.text_file import read_text

COLUMNS = "t_s,x_m,y_m,z_m"

# More than an hour with a row for each of the usual sampling periods.
MOST_ROWS = 100_000


class PathFileError(ValueError):
    """An invalid path file: the text has the row, counted from 1 below the heading, expected and got."""


def way_of(path: Path) -> list[list[float]]:
    """Return the path in a CSV file as rows of time and position, both relative to the first row.

    It has the columns `COLUMNS`, at least two rows, and growing times. Positions may count from anywhere.

    Raises: PathFileError: it cannot be read, or is invalid.
    """
    try:
        lines = read_text(path).splitlines()
    except OSError as error:
        raise PathFileError(f"cannot read {path} ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise PathFileError(f"{path}: expected UTF-8 text, got other bytes") from error
    heading, *rest = lines or [""]
    if heading.replace(" ", "") != COLUMNS:
        raise PathFileError(f"{path}: expected the heading {COLUMNS}, got {heading[:60]!r}")
    rows = [_row(path, number, line) for number, line in enumerate(filter(str.strip, rest), start=1)]
    if not 2 <= len(rows) <= MOST_ROWS:
        raise PathFileError(f"{path}: expected 2 to {MOST_ROWS} rows, got {len(rows)}")
    for number in range(1, len(rows)):
        if rows[number][0] <= rows[number - 1][0]:
            expected = f"expected a time > {rows[number - 1][0]:g} s"
            raise PathFileError(f"{path}: row {number + 1}: {expected}, got {rows[number][0]:g}")
    return [[value - first for value, first in zip(row, rows[0], strict=True)] for row in rows]


def with_paths(tree: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return a scenario's tree, as read from TOML, with tables in place of the files that its phases name.

    The tree is left as it is where it is no valid scenario; `folder` is that of the scenario.

    Raises: PathFileError: as `way_of`, its text preceded by the number of the phase and a blank.
    """
    maneuver = tree.get("maneuver")
    phases = maneuver.get("phase") if isinstance(maneuver, dict) else None
    if not isinstance(maneuver, dict) or not isinstance(phases, list):
        return tree
    return {**tree, "maneuver": {**maneuver, "phase": [_with_path(i, p, folder) for i, p in enumerate(phases, 1)]}}


def _with_path(number: int, phase: Any, folder: Path) -> Any:
    if not (isinstance(phase, dict) and isinstance(phase.get("file"), str)):
        return phase
    given = [key for key in ("duration_s", "displacement_m", "way") if key in phase]
    try:
        if given:
            raise PathFileError(f"expected no {given[0]} next to `file`, which defines it")
        way = way_of(folder / phase["file"])
    except PathFileError as error:
        raise PathFileError(f"{number} {error}") from error
    duration_s, *displacement_m = way[-1]
    kept = {key: value for key, value in phase.items() if key != "file"}
    return {**kept, "duration_s": duration_s, "displacement_m": displacement_m, "way": way}


def _row(path: Path, number: int, line: str) -> list[float]:
    words = line.split(",")
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != len(COLUMNS.split(",")) or not all(map(math.isfinite, values)):
        raise PathFileError(f"{path}: row {number}: expected 4 finite numbers {COLUMNS}, got {line[:60]!r}")
    return values
