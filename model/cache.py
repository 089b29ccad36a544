"""The cache folder of compiled models. A cache that cannot be read or written only costs time."""

import os
import tempfile
from pathlib import Path


def cache_folder() -> Path:
    """Return $PAYLOAD_TRANSPORT_CACHE, or the user's cache folder."""
    named = os.environ.get("PAYLOAD_TRANSPORT_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "payload-transport"


def replace_atomically(path: Path, content: bytes) -> bool:
    """Write a file that other processes see in full or not at all; return False if that fails."""
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            temporary = Path(file.name)
            file.write(content)
        os.replace(temporary, path)
    except OSError:
        # A read-only home or a full disk must not stop a run.
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        return False
    return True
