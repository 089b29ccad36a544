"""The file of a log that goes on in a second place when it is removed, cut, or cannot be written any more."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import orjson
from mcap.records import Channel, Message

from transport.log.channels import TOKENS
from transport.log.log_file import Entry, LogFile
from transport.log.salvage import LOST, NotMcapError, Salvage


class RelocatingFile:
    """A file with the methods of `LogFile` that do not fail.

    At the first failure all that can be read of the file is copied to the second place, also if its name is gone, and
    the log goes on there: the second file is the whole log. If that fails too, later entries are dropped.

    Args:
        path, header: As of `LogFile`.
        second_place: Function that makes a folder and returns the path of the log in it; may raise OSError.
        say: Function called with a sentence about each failure.

    Attributes:
        lost: Why entries are dropped; empty as long as all are written.

    Raises: OSError: the first file cannot be written.
    """

    def __init__(
        self, path: Path, header: Mapping[str, str], second_place: Callable[[], Path], say: Callable[[str], None]
    ) -> None:
        self.lost = ""
        self._header, self._second_place, self._say = header, second_place, say
        self._file = LogFile(path, header)
        self._written = path.open("rb")  # can be read when its name is gone
        self._has_moved = False

    @property
    def path(self) -> Path:
        """The file with the newest entries."""
        return self._file.path

    @property
    def pending(self) -> list[Entry]:
        """Entries of the unfinished chunk."""
        return [] if self.lost else self._file.pending

    @property
    def closed(self) -> bool:
        """Whether the file was closed by `close`."""
        return self._written.closed

    def append(self, entry: Entry) -> None:
        """Append an entry."""
        self._do(lambda file: file.append(entry))

    def finish_old(self, received_ns: int) -> None:
        """Finish the chunk if its first entry is too old when one arrives at a time, ns since 1970."""
        self._do(lambda file: file.finish_old(received_ns))

    def flush(self) -> None:
        """Finish the chunk."""
        self._do(lambda file: file.flush())

    def close(self) -> None:
        """Write the index and close the file."""
        self._do(lambda file: file.close())
        if not self.lost:
            self._do(lambda file: file.close())  # of the second place, if closing the first one failed
        self._written.close()

    def _do(self, action: Callable[[LogFile], None]) -> None:
        """Do an action; after its failure go on in the second place, where its entry is among those taken over."""
        if self.lost:
            return
        try:
            action(self._file)
        except OSError as error:
            reason = f"{self._file.path}: cannot write the log ({error.strerror or error})"
            if self._has_moved:
                self._lose(reason)
            else:
                self._move(reason)

    def _move(self, reason: str) -> None:
        self._has_moved = True
        second: Path | str = "a second place"
        try:
            second = self._second_place()
            file = LogFile(second, self._header)
            for entry in self._readable():
                file.append(entry)
            for entry in self._file.pending:
                file.append(_announcing_all(entry))
            file.flush()
        except OSError as error:
            self._lose(f"{reason}, nor continue in {second} ({error.strerror or error})")
            return
        self._file = file
        self._say(f"{reason}; recording continues in {file.path}")

    def _lose(self, reason: str) -> None:
        self.lost = reason
        self._say(f"{reason}: the run continues without recording")

    def _readable(self) -> Iterator[Entry]:
        """Yield the entries of the first file that are whole, without those that are pending."""
        pending = set(self._file.pending)
        for channel, message in self._salvaged():
            entry = Entry(
                channel.topic,
                channel.message_encoding,
                message.data,
                message.log_time,
                message.publish_time,
                message.sequence,
            )
            if channel is not LOST and entry not in pending:
                yield entry

    def _salvaged(self) -> Iterator[tuple[Channel, Message]]:
        with suppress(NotMcapError, OSError):
            self._written.seek(0)
            yield from Salvage(self._written).entries()


def _announcing_all(entry: Entry) -> Entry:
    """Return an entry, with all tokens announced anew if it has tokens: messages behind a gap may be of any tick."""
    if entry.topic != TOKENS:
        return entry
    announced = orjson.loads(entry.data)["announced"]
    return entry._replace(data=orjson.dumps({"announced": announced, "now": list(announced)}))
