"""The link `runs/latest` to the most recent run folder."""

import os
from contextlib import suppress
from pathlib import Path

# Folder whose runs have the link, and the name of the link.
_RUNS, LATEST = "runs", "latest"


def point_latest(folder: Path) -> None:
    """Point `latest` beside a run folder at it, if both are in a folder named `runs`.

    The link is replaced atomically. Nothing happens where the system has no symbolic links, or something else has that
    name.
    """
    link = folder.parent / LATEST
    if folder.resolve().parent.name != _RUNS or folder.name == LATEST:
        return
    new = link.with_name(f".{LATEST}.{os.getpid()}")
    with suppress(OSError, NotImplementedError):
        new.symlink_to(folder.name, target_is_directory=True)
        try:
            if link.is_symlink() or not link.exists():
                os.replace(new, link)
        finally:
            new.unlink(missing_ok=True)


def forget_latest(folder: Path) -> None:
    """Remove `latest` if it names a run folder that is removed."""
    link = folder.parent / LATEST
    with suppress(OSError):
        if link.is_symlink() and link.readlink() == Path(folder.name):
            link.unlink()
