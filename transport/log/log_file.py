"""The MCAP file of a log, in chunks, each of which can be read as soon as it is written."""

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from errno import EIO, ENOENT
from pathlib import Path
from tempfile import TemporaryFile
from typing import NamedTuple

from mcap.writer import CompressionType, Writer

from transport.log.chunk_indexes import ChunkIndexes

# Name of the metadata record that describes the run.
METADATA = "run"
# A chunk ends at this size, before compression (about ten ticks of four agents), or at this age. A kill loses at most
# one chunk; live readers wait for it.
CHUNK_BYTES = 64 * 1024
CHUNK_S = 0.05
_CHUNK_NS = round(CHUNK_S * 1e9)
# The cheapest one: see docs/decisions.md.
_COMPRESSION = CompressionType.LZ4


class Entry(NamedTuple):
    """An entry of the log: channel, its encoding, bytes, times in ns and a number that fit the fields of MCAP."""

    topic: str
    encoding: str
    data: bytes
    log_ns: int
    received_ns: int
    sequence: int


class LogFile:
    """Writes entries to a new file. After a failure the file is closed as it is and nothing more is written.

    Nothing may follow a record that was written in part: no reader would find it.

    Args:
        path: File to create.
        header: Metadata of the run.

    Attributes:
        path: The file.
        pending: Entries of the unfinished chunk, which are not known to be in the file.
        closed: Whether the file is closed.

    Raises: OSError: the file cannot be written, also from every method.
    """

    def __init__(self, path: Path, header: Mapping[str, str]) -> None:
        self.path, self.closed = path, False
        self.pending: list[Entry] = []
        self._pending_bytes = 0
        self._channels: dict[str, int] = {}
        with ExitStack() as opened:
            self._file = opened.enter_context(path.open("wb"))
            indexes = opened.enter_context(TemporaryFile(dir=path.parent))
            self._writer = Writer(
                self._file, chunk_size=2 * CHUNK_BYTES, compression=_COMPRESSION, enable_data_crcs=True
            )
            ChunkIndexes(indexes).attach(self._writer)
            self._writer.start(library="payload-transport")
            self._writer.add_metadata(METADATA, dict(header))
            self._file.flush()
            self._size = self._file.tell()  # of the file, as far as it was flushed
            self._opened = opened.pop_all()

    def append(self, entry: Entry) -> None:
        """Append an entry; finish its chunk if it has its size."""
        self.pending.append(entry)
        self._pending_bytes += len(entry.data)
        with self._closed_on_error():
            channel = self._channels.get(entry.topic)
            if channel is None:
                channel = self._writer.register_channel(entry.topic, entry.encoding, 0)
                self._channels[entry.topic] = channel
            self._writer.add_message(channel, entry.log_ns, entry.data, entry.received_ns, entry.sequence)
        if self._pending_bytes > CHUNK_BYTES:
            self.flush()

    def finish_old(self, received_ns: int) -> None:
        """Finish the chunk if its first entry is too old when one arrives at a time, ns since 1970."""
        if self.pending and received_ns - self.pending[0].received_ns > _CHUNK_NS:
            self.flush()

    def flush(self) -> None:
        """Finish the chunk: all entries are in the file."""
        with self._closed_on_error():
            self._check()
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._file.flush()
            self._size = self._file.tell()
            self.pending.clear()
            self._pending_bytes = 0

    def close(self) -> None:
        """Write the index and close the file; a second time, or after a failure, does nothing."""
        if not self.closed:
            with self._closed_on_error():
                self._check()
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._file.flush()
                self.pending.clear()
            self.closed = True
            self._opened.close()

    def _check(self) -> None:
        """Raise OSError if the file at the path is another one, or was cut: writing to it would not fail."""
        own = os.fstat(self._file.fileno())
        try:
            is_there = os.path.samestat(self.path.stat(), own)
        except OSError:
            is_there = False
        if not is_there:
            raise OSError(ENOENT, "the file was removed")
        if own.st_size < self._size:
            raise OSError(EIO, "the file was cut")

    @contextmanager
    def _closed_on_error(self) -> Iterator[None]:
        """Close the file as it is when a write fails."""
        try:
            yield
        except OSError:
            self.closed = True
            with suppress(OSError):
                self._opened.close()
            raise
