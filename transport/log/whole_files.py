"""Files that get their name only when they are complete: any content, and tables as CSV."""

import csv
import io
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

# End of the name of a file that is not complete, which a kill leaves.
PARTIAL = ".partial"


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> None:
    """Write a table atomically; floats are written by repr, which reads back as the same bits."""
    with atomic_file(path) as file, io.TextIOWrapper(file, encoding="utf-8", newline="") as text:
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically."""
    with atomic_file(path) as file:
        file.write(content)


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file that gets its name only when it is complete."""
    partial = path.with_name(path.name + PARTIAL)
    with partial.open("wb") as file:
        yield file
    os.replace(partial, path)
