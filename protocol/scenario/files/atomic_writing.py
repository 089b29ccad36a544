"""Files that a kill or a full disk leaves whole: any content, tables as CSV, and lines added one by one."""

import csv
import io
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from transport.protocol.wire.errors_and_exit_codes import EXIT_UNRECORDED, TransportError

# End of the name of a file that is not complete, which a kill leaves.
PARTIAL = ".partial"


class UnwrittenError(TransportError, OSError):
    """A file that cannot be written, as on a full disk; the text names it and the reason."""

    exit_code = EXIT_UNRECORDED

    @staticmethod
    def of(path: Path, error: OSError) -> "UnwrittenError":
        """Return the error of a file."""
        return UnwrittenError(error.errno, error.strerror or str(error), str(path))

    def __str__(self) -> str:
        return f"cannot write {self.filename} ({self.strerror})"


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> None:
    """Write a table atomically; floats are written by repr, which reads back as the same bits.

    Raises: UnwrittenError.
    """
    with atomic_file(path) as file, io.TextIOWrapper(file, encoding="utf-8", newline="") as text:
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file atomically, a text as UTF-8. Raises: UnwrittenError."""
    with atomic_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file that gets its name only when it is complete.

    Raises: UnwrittenError: it cannot be written; a file of this name stays as it was.
    """
    partial = path.with_name(path.name + PARTIAL)
    try:
        with partial.open("wb") as file:
            yield file
        os.replace(partial, path)
    except BaseException as error:
        with suppress(OSError):
            partial.unlink()
        if isinstance(error, OSError):
            raise UnwrittenError.of(path, error) from error
        raise


class Lines:
    """A file to which lines are added, each on the disk at once.

    A line that a kill has cut takes none of the next ones with it.

    Raises: UnwrittenError: it cannot be opened or written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = path.open("ab+", buffering=0)
        except OSError as error:
            raise UnwrittenError.of(path, error) from error

    def read(self) -> list[bytes]:
        """Return the lines so far."""
        self._file.seek(0)
        kept = self._file.read()
        if kept and not kept.endswith(b"\n"):
            self._write(b"\n")
        return kept.splitlines()

    def add(self, line: bytes) -> None:
        """Add a line, whole or not at all. Raises: UnwrittenError."""
        self._write(line + b"\n")

    def _write(self, content: bytes) -> None:
        """Write to the end of the file; after an error it is as before."""
        before = self._file.seek(0, os.SEEK_END)
        written = 0
        try:
            while written < len(content):  # a disk that becomes full takes a part
                written += self._file.write(content[written:])
        except OSError as error:
            with suppress(OSError):
                self._file.truncate(before)
            raise UnwrittenError.of(self._path, error) from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()
