"""The log of a run: every message in one MCAP file that viewers open and that survives a kill.

Messages are JSON, one channel per key and one schema per kind. `log_time` is scenario time, so that viewers show the
run and not the host; `publish_time` is when the recorder received the message. The metadata record "run", ahead of
all messages, describes the run.
"""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import TypeVar

from mcap.writer import Writer

from protocol.wire.keys import Keys
from protocol.wire.messages import KINDS, Control, FaultNote, LinkChange, Message, Plan
from transport.log.chunk_indexes import ChunkIndexes
from transport.log.json_messages import JsonChannels, from_json, to_json
from transport.log.salvage import NotMcapError, Salvage

# A chunk ends at this size, before compression (about three ticks of four agents), or at this age. A kill loses at most
# one chunk; live readers wait for it. Larger chunks hardly compress better.
CHUNK_BYTES = 64 * 1024
CHUNK_S = 0.05
_CHUNK_NS = round(CHUNK_S * 1e9)

_METADATA = "run"
# Metadata record of a copy for other viewers: names the channels that were derived from the messages of the log.
DERIVED = "derived channels"
_KEYS = Keys("log")
_LAST_TIME_NS = 2**63 - 1
_SEQUENCES = 2**32  # MCAP numbers have 32 bits; the JSON holds the full number

M = TypeVar("M", bound=Message)


class LogError(RuntimeError):
    """A log that cannot be read or written; the text names the file and the reason."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    """A message as it was sent, and the wall-clock time at which the recorder received it, ns since 1970."""

    message: Message
    received_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RunLog:
    """Content of a log.

    Attributes:
        header: Metadata of the run: run_id, scenario (TOML), versions, machine, ...
        messages: In the order they were received.
        cut: Sentence about what is missing; empty for a complete log.
    """

    header: dict[str, str]
    messages: tuple[Recorded, ...]
    cut: str

    def of(self, kind: type[M]) -> Iterator[M]:
        """Yield the messages of one kind, in order."""
        return (entry.message for entry in self.messages if isinstance(entry.message, kind))

    def received_ns(self, kind: type[Message]) -> dict[int, int]:
        """Return when the first message of one kind was received at each tick, ns since 1970."""
        times: dict[int, int] = {}
        for entry in self.messages:
            if isinstance(entry.message, kind):
                times.setdefault(entry.message.tick, entry.received_ns)
        return times


class LogWriter:
    """Writes the log of one run. The file can be read at any moment; a kill loses at most the unfinished chunk.

    Args:
        path: File to create.
        header: Metadata of the run, as `read_log` returns it.
        period_ns: Sampling period, ns: converts ticks to log times.
    Raises: LogError: the file cannot be written.
    """

    def __init__(self, path: Path, header: Mapping[str, str], *, period_ns: int) -> None:
        self._path = path
        self._period_ns = period_ns
        self._pending_bytes = 0  # JSON in the unfinished chunk
        self._pending_since_ns = 0  # arrival of its first message
        self._closed = False
        self._opened = ExitStack()
        with self._guarded(), ExitStack() as opened:
            file = opened.enter_context(path.open("wb"))
            indexes = opened.enter_context(TemporaryFile(dir=path.parent))
            self._writer = Writer(file, chunk_size=2 * CHUNK_BYTES, enable_data_crcs=True)
            ChunkIndexes(indexes).attach(self._writer)
            self._channels = JsonChannels(self._writer)
            self._writer.start(library="payload-transport")
            self._writer.add_metadata(_METADATA, dict(header))
            self._finish_chunk()
            self._opened = opened.pop_all()

    def __enter__(self) -> "LogWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_up_to_date(self) -> bool:
        """Whether all messages are in the file."""
        return self._closed or not self._pending_bytes

    def write(self, message: Message, received_ns: int) -> None:
        """Append a message that arrived at a wall-clock time, ns since 1970.

        Raises: LogError: the file cannot be written, or is closed.
        """
        if self._closed:
            raise LogError(f"{self._path}: the log is closed, got a {message.kind}")
        data = to_json(message)
        with self._guarded():
            if self._pending_bytes and received_ns - self._pending_since_ns > _CHUNK_NS:
                self._finish_chunk()
            if not self._pending_bytes:
                self._pending_since_ns = received_ns
            self._pending_bytes += len(data)
            self._writer.add_message(
                self._channels.of_message(topic_of(message), message.kind),
                log_time=min(message.tick * self._period_ns, _LAST_TIME_NS),
                publish_time=min(max(received_ns, 0), _LAST_TIME_NS),
                sequence=message.sequence % _SEQUENCES,
                data=data,
            )
            # The end of the run and its faults must not wait for the closing of the log.
            if self._pending_bytes > CHUNK_BYTES or isinstance(message, Control | FaultNote):
                self._finish_chunk()

    def flush(self) -> None:
        """Write all messages to the file, for live readers and against kills.

        Raises: LogError: the file cannot be written.
        """
        if not self.is_up_to_date:
            with self._guarded():
                self._finish_chunk()

    def close(self) -> None:
        """Write the index and close the file; a second time, or after a failure, does nothing.

        Raises: LogError: the file cannot be written.
        """
        if self._closed:
            return
        with self._guarded():
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._closed = True
            self._opened.close()

    def _finish_chunk(self) -> None:
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._pending_bytes = 0

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Turn a failed write into a LogError and close the file as it is.

        Nothing may follow a record that was written in part: no reader would find it.
        """
        try:
            yield
        except OSError as error:
            self._closed = True
            with suppress(OSError):
                self._opened.close()
            raise LogError(f"{self._path}: cannot write the log ({error.strerror or error})") from error


def topic_of(message: Message) -> str:
    """Return the channel of a message; each kind has its own, also where kinds share a network key."""
    match message:
        case LinkChange():  # shares the key of the rosters
            return f"/{message.kind}"
        case Plan(agent=agent):  # has two keys
            return f"/{message.kind}/{agent}"
    return _KEYS.of(message).removeprefix(_KEYS.prefix)


def kind_of(topic: str) -> str:
    """Return the message kind of a channel of `topic_of`; another program's channel gives an unknown kind."""
    return topic.lstrip("/").split("/", 1)[0]


def read_log(path: Path, *, horizons: bool = True) -> RunLog:
    """Read all that can be read of a log.

    A file cut or damaged anywhere behind its first bytes gives the messages of every intact chunk and a sentence in
    `cut`. Messages equal the written ones bit for bit.

    Args:
        path: The file.
        horizons: Keep whole plans. Otherwise plans have their first step only and no corrections, which saves most of
            the memory.
    Raises: LogError: no such file, not an MCAP file, or not the log of a run.
    """
    messages: list[Recorded] = []
    unknown: list[tuple[str, str]] = []  # channel and description
    try:
        with path.open("rb") as file:
            salvage = Salvage(file)
            for topic, entry in salvage.entries():
                kind = kind_of(topic)
                if kind not in KINDS:
                    unknown.append((topic, f"a channel {topic!r}"))
                    continue
                try:
                    message = from_json(kind, entry.data)
                except (ValueError, TypeError) as error:
                    unknown.append((topic, f"{kind}: {error}"))
                    continue
                if not horizons and isinstance(message, Plan):
                    message = replace(message, inputs=message.inputs[:1].copy(), corrections=message.corrections[:0])
                messages.append(Recorded(message=message, received_ns=entry.publish_time))
    except OSError as error:
        raise LogError(f"{path}: cannot read the log ({error.strerror or error})") from error
    except NotMcapError as error:
        raise LogError(f"{path}: {error}") from error
    header = salvage.metadata.get(_METADATA)
    if header is None and salvage.ended and not salvage.damaged:
        raise LogError(f'{path}: an MCAP file, but not the log of a run (no metadata record "{_METADATA}")')
    derived = salvage.metadata.get(DERIVED, {})
    cut = _cut(messages, [text for topic, text in unknown if topic not in derived], salvage)
    return RunLog(header=header or {}, messages=tuple(messages), cut=cut)


def _cut(messages: list[Recorded], unknown: list[str], salvage: Salvage) -> str:
    """Return a sentence about what is missing; empty for a whole log."""
    problems = []
    if not salvage.ended:
        problems.append("only its index is missing" if salvage.data_ended else "it stops before its end")
    if salvage.damaged:
        problems.append(f"{salvage.damaged} damaged part{'s' if salvage.damaged > 1 else ''} left out")
    if unknown:
        problems.append(f"{len(unknown)} entries are not of this version, the first {unknown[0]}")
    if not problems:
        return ""
    last = max((entry.message.tick for entry in messages), default=None)
    readable = "no message is readable" if last is None else f"{len(messages)} messages are readable, up to tick {last}"
    return f"the log is not whole ({'; '.join(problems)}): {readable}"
