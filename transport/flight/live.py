"""Active runs on this machine: a file in the run folder that exists while the run is active."""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import orjson

_FILE = "live.json"


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


def write(folder: Path, run: LiveRun) -> None:
    """Mark a run as active."""
    (folder / _FILE).write_bytes(orjson.dumps(asdict(run)))


def remove(folder: Path) -> None:
    """Mark the run of a folder as ended."""
    (folder / _FILE).unlink(missing_ok=True)


def read(folder: Path) -> LiveRun | None:
    """Return the active run of a folder, or None; the file of a killed run is ignored."""
    try:
        content = orjson.loads((folder / _FILE).read_bytes())
        run = LiveRun(**content)
        os.kill(run.pid, 0)
    except (OSError, ValueError, TypeError):
        return None
    return run


def newest_folder(parent: Path) -> Path | None:
    """Return the folder of the most recent active run below a folder."""
    found = (path for path in parent.glob(f"*/{_FILE}") if not path.parent.is_symlink())  # `latest` is one of them
    folders = sorted(found, key=lambda path: path.stat().st_mtime, reverse=True)
    return next((path.parent for path in folders if read(path.parent) is not None), None)
