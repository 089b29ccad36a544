"""Writer of the log of a run: one MCAP file in chunks.

Each chunk can be read as soon as it is written.

One record for each message or bundle that the recorder received, with its bytes, in a channel for
each key. `log_time` is scenario time, `publish_time` is when the recorder received the message.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from errno import ENOENT
from pathlib import Path

from mcap.writer import CompressionType, IndexType, Writer

from transport.log.run_log import ENCODING, METADATA, LogError, channel_of
from transport.protocol.wire.codec import Header, encode
from transport.protocol.wire.messages import Control, FaultNote, Message

# A chunk ends at this size, before compression (about ten ticks of four agents), or at this age. A
# kill loses at most one chunk; live readers wait for it.
CHUNK_BYTES = 64 * 1024
_CHUNK_NS = 50_000_000
# Kinds of messages that are in the file as soon as they are written: the end of the run and its
# faults do not wait for the closing of the log.
_URGENT = (Control.kind, FaultNote.kind)
# Largest time of an MCAP record, ns.
LAST_TIME_NS = 2**63 - 1
# Number of sequence numbers of an MCAP record; the message has the full number.
SEQUENCES = 2**32


class LogWriter:
    """Writes the log of one run.

    The file can be read at any moment; a kill loses at most the unfinished chunk. A failed write
    closes the file. With `say` it is told, and further messages are dropped; without `say` it
    raises LogError.
    """

    def __init__(
        self,
        path: Path,
        header: Mapping[str, str],
        *,
        period_ns: int,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self.lost = ""  # why messages are dropped
        self.is_up_to_date = True  # whether all messages are in the file
        self._path = path
        self._period_ns = period_ns
        self._say = say
        self._channels: dict[str, int] = {}
        # Reception of the first message of the unfinished chunk, ns, and the size of the chunk.
        self._begun_ns = 0
        self._bytes = 0

        try:
            self._file = path.open("wb")
            # Without an index of messages, which would grow in memory; LZ4 is the cheapest, see
            # docs/record/decisions.md.
            self._writer = Writer(
                self._file,
                chunk_size=2 * CHUNK_BYTES,
                compression=CompressionType.LZ4,
                index_types=IndexType.METADATA,
                enable_data_crcs=True,
            )
            self._writer.start(library="payload-transport")
            self._writer.add_metadata(METADATA, dict(header))
            self._file.flush()
        except OSError as error:
            raise self._error(error) from error

    def write(self, message: Message, received_ns: int) -> None:
        """Append a message received at a wall-clock time, ns since 1970."""
        self.add(channel_of(message), encode(message), message, received_ns)

    def add(self, topic: str, data: bytes, header: Header | Message, received_ns: int) -> None:
        """Append a message as it came, with its header, to the channel of its key."""
        if received_ns - self._begun_ns > _CHUNK_NS:
            self.flush()
        if self._file.closed:
            return

        with self._guarded():
            if self.is_up_to_date:
                self._begun_ns = received_ns
            if topic not in self._channels:
                self._channels[topic] = self._writer.register_channel(topic, ENCODING, 0)
            channel = self._channels[topic]
            log_ns = min(max(header.tick * self._period_ns, 0), LAST_TIME_NS)
            sequence = header.sequence % SEQUENCES
            self._writer.add_message(channel, log_ns, data, received_ns, sequence)
            self._bytes += len(data)
            self.is_up_to_date = False

        if header.kind in _URGENT or self._bytes > CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Finish the chunk: all messages are in the file, for live readers and against kills."""
        if self.is_up_to_date:
            return

        with self._guarded():
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._file.flush()
            self._check_kept()
            self._bytes = 0
            self.is_up_to_date = True

    def close(self) -> None:
        """Write the summary and close the file; a second time, or after a failure, does nothing."""
        if self._file.closed:
            return

        with self._guarded():
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._check_kept()
            self._file.close()
        self.is_up_to_date = True

    def _check_kept(self) -> None:
        """Raise OSError if the file, or its folder, has been removed: messages would be lost."""
        if os.fstat(self._file.fileno()).st_nlink == 0:
            raise FileNotFoundError(ENOENT, "the file has been removed")

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Close the file as it is when a write fails; tell, or raise LogError."""
        try:
            yield
        except OSError as error:
            with suppress(OSError):
                self._file.close()
            self.is_up_to_date = True

            failure = self._error(error)
            if self._say is None:
                raise failure from error
            self.lost = str(failure)
            self._say(f"{failure}: the run continues without recording")

    def _error(self, error: OSError) -> LogError:
        """Return the error of a log that cannot be written."""
        return LogError(f"{self._path}: cannot write the log ({error.strerror or error})")
