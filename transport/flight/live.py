"""Active runs on this machine: a file in the run folder that exists while the run is active."""

import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import orjson

from protocol.wire.keys import Keys
from protocol.wire.names import COORDINATOR

_FILE = "live.json"
# Longest value in an error, characters.
_SHOWN = 60


@dataclass(frozen=True, slots=True)
class LiveRun:
    """An active run.

    Attributes:
        run: Its name.
        endpoints: Endpoints of its processes, by name.
        pid: Process id of their parent.
        keys: Folder of their keys; empty without keys.
        is_client: Whether the endpoints belong to a router.
    """

    run: str
    endpoints: Mapping[str, str]
    pid: int
    keys: str = ""
    is_client: bool = False


class LiveError(ValueError):
    """A file that should describe an active run and does not; one line with file, field, got, expected."""


def write(folder: Path, run: LiveRun) -> None:
    """Mark a run as active; a folder that cannot be written is left unmarked."""
    new = folder / f".{_FILE}"
    with suppress(OSError):
        new.write_bytes(orjson.dumps(asdict(run)))
        new.replace(folder / _FILE)


def remove(folder: Path) -> None:
    """Mark the run of a folder as ended."""
    with suppress(OSError):
        (folder / _FILE).unlink()


def read(folder: Path) -> LiveRun | None:
    """Return the active run of a folder, or None; the file of a killed run is ignored.

    Raises: LiveError: the file has other content.
    """
    path = folder / _FILE
    try:
        data = path.read_bytes()
    except OSError:
        return None
    try:
        content = orjson.loads(data)
    except ValueError:
        raise LiveError(f"{path}: expected a JSON object, got {_shown(data.decode(errors='replace'))}") from None
    if not isinstance(content, dict):
        raise LiveError(f"{path}: expected a JSON object, got {_shown(content)}")
    for field, (expected, is_valid) in _FIELDS.items():
        if field not in content:
            raise LiveError(f"{path}: {field}: expected {expected}, got nothing")
        if not is_valid(content[field]):
            raise LiveError(f"{path}: {field}: expected {expected}, got {_shown(content[field])}")
    run = LiveRun(**{field: content[field] for field in _FIELDS})
    try:
        os.kill(run.pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:  # a process of another user
        pass
    return run


def _are_endpoints(value: object) -> bool:
    return (
        isinstance(value, dict)
        and COORDINATOR in value
        and all(isinstance(at, str) and re.fullmatch(r"[a-z0-9-]+/\S+", at) for at in value.values())
    )


def _shown(value: object) -> str:
    """Return a value in an error, cut to a length that fits a line."""
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


# What each field is expected to be, and its check.
_FIELDS: Mapping[str, tuple[str, Callable[[Any], bool]]] = {
    "run": ("the name of a run", lambda value: isinstance(value, str) and Keys.allows(value)),
    "endpoints": (f"Zenoh endpoints by process, with that of {COORDINATOR}", _are_endpoints),
    "pid": (
        "the number of a process",
        lambda value: isinstance(value, int) and not isinstance(value, bool) and 0 < value < 2**31,
    ),
    "keys": ("a folder or an empty text", lambda value: isinstance(value, str)),
    "is_client": ("true or false", lambda value: isinstance(value, bool)),
}


def newest_folder(parent: Path) -> Path | None:
    """Return the folder of the most recent active run below a folder.

    Raises: LiveError: the file of a more recent run has other content.
    """
    found = []
    for path in parent.glob(f"*/{_FILE}"):
        if path.parent.is_symlink():
            continue  # `latest` is one of the others
        with suppress(OSError):  # removed since
            found.append((path.stat().st_mtime, path.parent))
    return next((folder for _, folder in sorted(found, reverse=True) if read(folder) is not None), None)
