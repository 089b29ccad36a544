"""Constant memory of `mcap.writer.Writer` during a run: chunk indexes are in a file, not in a growing list."""

from collections.abc import Iterator
from typing import BinaryIO

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import Writer


class ChunkIndexes:
    """Chunk indexes of one writer, encoded in a file until the writer's `finish` copies them.

    The library has no interface for this, so `attach` replaces the private list of mcap 1.x; a test on the memory of
    a long log fails if a later release does not use it. The file is empty and open for reading and writing.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

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
