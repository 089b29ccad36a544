"""Register of this user's active runs on this machine, wherever their folders are.

A folder in the temporary one that only this user can read holds a link to each run folder. A run
that was killed leaves its link, so a link alone says nothing: `transport.flight.active_runs` decides.
"""

import hashlib
import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

# Environment variable that names another place, for tests and for users who share an account.
PLACE = "PAYLOAD_TRANSPORT_ACTIVE"


def place() -> Path:
    """Return the folder of the register, which may not exist yet."""
    named = os.environ.get(PLACE)
    return Path(named or Path(tempfile.gettempdir()) / f"payload-transport-{os.getuid()}")


def add(folder: Path) -> None:
    """Register a run folder.

    Without a safe place for the register the run is found by its folder only.
    """
    with suppress(OSError):
        place().mkdir(mode=0o700, exist_ok=True)
        if not _is_private(place()):
            return

        link = _link_to(folder)
        link.unlink(missing_ok=True)
        link.symlink_to(folder.absolute(), target_is_directory=True)


def remove(folder: Path) -> None:
    """Remove a run folder from the register, if it is there."""
    with suppress(OSError):
        if _is_private(place()):
            _link_to(folder).unlink(missing_ok=True)


def folders() -> list[Path]:
    """Return the registered folders, in the order of their paths.

    Some of their runs may have ended.
    """
    try:
        if not _is_private(place()):
            return []
        return sorted(link.readlink() for link in place().iterdir() if link.is_symlink())
    except OSError:
        return []


def _link_to(folder: Path) -> Path:
    """Return the path of the link to a run folder."""
    digest = hashlib.sha256(os.fsencode(folder.absolute())).hexdigest()
    return place() / digest[:16]


def _is_private(path: Path) -> bool:
    """Return whether a path is a folder of this user that no other user can change."""
    status = path.lstat()
    is_own = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid()
    return is_own and not status.st_mode & 0o077
