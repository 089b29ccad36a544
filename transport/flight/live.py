"""Where the runs are that fly now: a small file in the run folder, there as long as the run is."""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import orjson

_FILE = "live.json"


@dataclass(frozen=True, slots=True)
class LiveRun:
    """A run that flies.

    Attributes:
        run: Its name.
        endpoints: Of its processes, by name.
        pid: Of the process that started them.
        keys: Folder of the keys they use, or nothing.
        is_client: Whether the endpoints are those of a router.
    """

    run: str
    endpoints: Mapping[str, str]
    pid: int
    keys: str = ""
    is_client: bool = False


def write(folder: Path, run: LiveRun) -> None:
    """Say that a run flies."""
    (folder / _FILE).write_bytes(orjson.dumps(asdict(run)))


def remove(folder: Path) -> None:
    """Say that it no longer does."""
    (folder / _FILE).unlink(missing_ok=True)


def read(folder: Path) -> LiveRun | None:
    """The run that flies in a folder, if one does; what a killed one has left behind does not count."""
    try:
        content = orjson.loads((folder / _FILE).read_bytes())
        run = LiveRun(
            run=content["run"],
            endpoints=dict(content["endpoints"]),
            pid=content["pid"],
            keys=content["keys"],
            is_client=content["is_client"],
        )
        os.kill(run.pid, 0)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return run


def newest(parent: Path) -> LiveRun | None:
    """The run started last of those that fly in the folders below one."""
    folder = newest_folder(parent)
    return None if folder is None else read(folder)


def newest_folder(parent: Path) -> Path | None:
    """Its folder."""
    folders = sorted(parent.glob(f"*/{_FILE}"), key=lambda path: path.stat().st_mtime, reverse=True)
    return next((path.parent for path in folders if read(path.parent) is not None), None)
