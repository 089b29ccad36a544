"""Reading of text files that a user names: never a device or a pipe without end, never more than fits."""

import errno
import stat
from pathlib import Path

# A path of 100,000 rows has some 5 MB.
MOST_BYTES = 64_000_000


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
