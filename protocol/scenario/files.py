"""Files that a scenario names: tables of paths and of measured delays.

The table of a path becomes part of the scenario when that is read: it is in the fingerprint that the processes of a run
compare, and in the run folder, without the file.
"""

import errno
import math
import os
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from protocol.wire.errors import TransportError
from protocol.wire.message import MAX_POINTS

# A path of 100,000 rows has some 5 MB.
MOST_BYTES = 64_000_000
COLUMNS = "t_s,x_m,y_m,z_m"
# More than an hour with a row for each of the usual sampling periods.
MOST_ROWS = 100_000


class TableError(TransportError, ValueError):
    """An invalid file of a scenario: the text has the row, counted from 1 below the heading, expected and got."""


def path_problem(path: str | Path) -> str:
    """Return why the path of a file cannot be used: over 255 bytes, a null character, not UTF-8; empty if it can."""
    try:
        str(path).encode()
        Path(path).stat()
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return ""
    except UnicodeEncodeError:
        return "not UTF-8"
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", "") or str(error)
    return ""


def read_text(path: Path, *, regular: bool = True) -> str:
    """Return the UTF-8 text of a file; `regular` refuses pipes and devices, whose reading may never end.

    Raises: OSError: it cannot be read, is not regular or too large; UnicodeDecodeError: it is not UTF-8.
    """
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "expected a path without null character")
    if regular and not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "expected a regular file")
    with path.open("rb") as file:
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise OSError(errno.EFBIG, f"expected at most {MOST_BYTES:,} bytes")
    return content.decode("utf-8").replace("\r\n", "\n")


def anchored(value: Any, here: Path, folder: Path | None = None, key: str = "") -> Any:
    """Return part of a scenario's tree, whose files are relative to the folder `here`, for a scenario in `folder`.

    Files below `folder` are named relative to it, others by their absolute paths, as are all without a folder.
    """
    if isinstance(value, list):
        return [anchored(entry, here, folder, key) for entry in value]
    if isinstance(value, dict):
        return {name: anchored(entry, here, folder, name) for name, entry in value.items()}
    if key in ("samples", "file") and isinstance(value, str) and not path_problem(value):
        # Without following links: a name stays as the user knows it.
        path, own = Path(os.path.abspath(here / value)), Path(os.path.abspath(folder or here))  # noqa: PTH100
        return str(path.relative_to(own) if folder and path.is_relative_to(own) else path)
    return value


def delays_of(path: Path) -> tuple[float, ...]:
    """Return the measured delays in a file, s, in ascending order.

    Raises: TableError: it cannot be read, or has other content.
    """
    try:
        values = [float(word) for word in read_text(path).replace(",", " ").split()]
    except OSError as error:
        raise TableError(f"cannot read {path} ({error.strerror})") from error
    except ValueError as error:
        raise TableError(f"{path}: expected delays in seconds, {error}") from error
    if not values or not all(0.0 <= value < math.inf for value in values):
        raise TableError(f"{path}: expected delays >= 0 s, got {values[:3]}")
    return tuple(sorted(values))


def way_of(path: Path) -> list[list[float]]:
    """Return the path in a CSV file as rows of time and position, both relative to the first row.

    It has the columns `COLUMNS`, at least two rows, and growing times. Positions may count from anywhere.

    Raises: TableError: it cannot be read, or is invalid.
    """
    _, rows = _table(path, [COLUMNS], 2, MOST_ROWS)
    for number in range(1, len(rows)):
        if rows[number][0] <= rows[number - 1][0]:
            expected = f"expected a time > {rows[number - 1][0]:g} s"
            raise TableError(f"{path}: row {number + 1}: {expected}, got {rows[number][0]:g}")
    return [[value - first for value, first in zip(row, rows[0], strict=True)] for row in rows]


def points_of(path: Path) -> tuple[list[list[float]], list[float] | None]:
    """Return the way points in a CSV file, m, and their times, s, if it has any.

    Its heading is x,y,z or t,x,y,z, each perhaps with its unit, as in `COLUMNS`.

    Raises: TableError: it cannot be read, or is invalid.
    """
    columns, rows = _table(path, ["x,y,z", "t,x,y,z", "x_m,y_m,z_m", COLUMNS], 1, MAX_POINTS)
    return [row[-3:] for row in rows], [row[0] for row in rows] if columns.startswith("t") else None


def _table(path: Path, headings: Sequence[str], least: int, most: int) -> tuple[str, list[list[float]]]:
    """Return the heading of a CSV file, one of those given, and its rows of numbers."""
    try:
        heading, *rest = read_text(path).splitlines() or [""]
    except OSError as error:
        raise TableError(f"cannot read {path} ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise TableError(f"{path}: expected UTF-8 text, got other bytes") from error
    columns = heading.replace(" ", "")
    if columns not in headings:
        raise TableError(f"{path}: expected the heading {' or '.join(headings)}, got {heading[:60]!r}")
    rows = [_row(path, number, line, columns) for number, line in enumerate(filter(str.strip, rest), start=1)]
    if not least <= len(rows) <= most:
        raise TableError(f"{path}: expected {least} to {most} rows, got {len(rows)}")
    return columns, rows


def with_paths(tree: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return a scenario's tree, as read from TOML, with tables in place of the files that its phases name.

    A phase with a table takes its duration and displacement from the table unless they are given. The tree is left as
    it is where it is no valid scenario; `folder` is that of the scenario.

    Raises: TableError: as `way_of`, its text preceded by the number of the phase and a blank.
    """
    maneuver = tree.get("maneuver")
    phases = maneuver.get("phase") if isinstance(maneuver, dict) else None
    if not isinstance(maneuver, dict) or not isinstance(phases, list):
        return tree
    return {**tree, "maneuver": {**maneuver, "phase": [_with_path(i, p, folder) for i, p in enumerate(phases, 1)]}}


def _with_path(number: int, phase: Any, folder: Path) -> Any:
    if not isinstance(phase, dict):
        return phase
    if isinstance(phase.get("file"), str):
        given = [key for key in ("duration_s", "displacement_m", "way") if key in phase]
        try:
            if given:
                raise TableError(f"expected no {given[0]} next to `file`, which defines it")
            way = way_of(folder / phase["file"])
        except TableError as error:
            raise TableError(f"{number} {error}") from error
        phase = {key: value for key, value in phase.items() if key != "file"} | {"way": way}
    match phase.get("way"):
        case [*_, [duration_s, *displacement_m]]:
            return {"duration_s": duration_s, "displacement_m": displacement_m, **phase}
    return phase


def _row(path: Path, number: int, line: str, columns: str) -> list[float]:
    try:
        values = [float(word) for word in line.split(",")]
    except ValueError:
        values = []
    count = len(columns.split(","))
    if len(values) != count or not all(map(math.isfinite, values)):
        raise TableError(f"{path}: row {number}: expected {count} finite numbers {columns}, got {line[:60]!r}")
    return values


def write_delays(samples_s: Mapping[str, Sequence[float]], folder: Path) -> None:
    """Write the files of measured delays that a scenario in a folder names, unless their paths are absolute.

    Args:
        samples_s: Delays by file, s.
        folder: Folder of the scenario.
    """
    for name, delays_s in samples_s.items():
        if not Path(name).is_absolute():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text("\n".join(map(repr, delays_s)) + "\n", encoding="utf-8")
