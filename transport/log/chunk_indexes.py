"""Constant memory for `mcap.writer.Writer`: chunk indexes in a file instead of a list that grows with the run."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryFile

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import Writer


class ChunkIndexes:
    """Chunk indexes of one writer, encoded in an unnamed file until the writer's `finish` copies them.

    The library has no interface for this, so `attach` replaces the private list of mcap 1.x; a test on the memory of
    a long log fails if a later release does not use it.

    Args:
        folder: Where the file is created.
    Raises: OSError: it cannot be created, or, in the other methods, written or read.
    """

    def __init__(self, folder: Path) -> None:
        self._file = TemporaryFile(dir=folder)

    def attach(self, writer: Writer) -> None:
        """Let a new writer use this in place of its list."""
        writer._Writer__chunk_indices = self  # type: ignore[attr-defined]

    def append(self, index: ChunkIndex) -> None:
        """Add the index of a finished chunk."""
        builder = RecordBuilder()
        index.write(builder)
        self._file.write(builder.end())  # type: ignore[no-untyped-call]

    def __iter__(self) -> Iterator["ChunkIndexes"]:
        yield self

    def write(self, builder: RecordBuilder) -> None:
        """Write all indexes as `ChunkIndex.write` writes one."""
        self._file.seek(0)
        builder.write(self._file.read())

    def close(self) -> None:
        """Delete the file."""
        self._file.close()
