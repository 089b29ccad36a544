"""The log of a run: every message as it came, in one MCAP file that survives a kill.

One record for each message or bundle that the recorder received, with its bytes, in a channel for each key. `log_time`
is scenario time, `publish_time` is when the recorder received the message. The metadata record "run", ahead of all
messages, describes the run. `transport log export` makes files for other programs.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import orjson

from protocol.scenario.setup import Setup
from protocol.wire.codec import encode
from protocol.wire.errors import TransportError
from protocol.wire.header import Header
from protocol.wire.keys import RECORDER
from protocol.wire.messages import Control, FaultNote, Message, MessageError, Plan
from transport.log.channels import ENCODING, TOKENS, TOKENS_ENCODING, channel_of, is_known
from transport.log.log_file import METADATA, Entry, LogFile
from transport.log.log_reception import LogReception, Read, setup_in
from transport.log.relocating_file import RelocatingFile
from transport.log.salvage import NotMcapError, Salvage

# Kinds of messages that are in the file as soon as they are written.
_URGENT = (Control.kind, FaultNote.kind)

# Largest time of an MCAP record, ns, and number of its sequence numbers.
LAST_TIME_NS = 2**63 - 1
SEQUENCES = 2**32  # MCAP numbers have 32 bits; the message has the full number

M = TypeVar("M", bound=Message)


class LogError(TransportError, RuntimeError):
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
        path: File to create, or an open file.
        header: Metadata of the run, as `read_log` returns it.
        period_ns: Sampling period, ns: converts ticks to log times.
    Raises: LogError: the file cannot be written.
    """

    def __init__(self, path: Path | RelocatingFile, header: Mapping[str, str], *, period_ns: int) -> None:
        self._path = path if isinstance(path, Path) else path.path
        self._period_ns = period_ns
        self._announced: dict[str, int] = {}  # newest incarnation of each process
        with self._guarded():
            self._file = LogFile(path, header) if isinstance(path, Path) else path

    def __enter__(self) -> "LogWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_up_to_date(self) -> bool:
        """Whether all messages are in the file."""
        return self._file.closed or not self._file.pending

    def write(self, message: Message, received_ns: int) -> None:
        """Append a message of this process, or one that was checked, received at a wall-clock time, ns since 1970.

        Raises: LogError: the file cannot be written, or is closed.
        """
        if message.sender != RECORDER and message.incarnation > self._announced.get(message.sender, -1):
            self.announce(message.sender, message.incarnation, received_ns)
        self.add(channel_of(message), encode(message), message, received_ns)

    def add(self, topic: str, data: bytes, header: Header | Message, received_ns: int) -> None:
        """Append a message as it came, with its header, to the channel of its key.

        Raises: LogError: the file cannot be written, or is closed.
        """
        self._append(topic, ENCODING, data, received_ns, header.tick, header.sequence)
        # The end of the run and its faults must not wait for the closing of the log.
        if header.kind in _URGENT:
            self.flush()

    def announce(self, name: str, incarnation: int, received_ns: int) -> None:
        """Append that the token of a process has appeared.

        Raises: LogError: the file cannot be written, or is closed.
        """
        self._announced[name] = max(incarnation, self._announced.get(name, -1))
        self._append(TOKENS, TOKENS_ENCODING, self._tokens(name), received_ns)

    def _tokens(self, *now: str) -> bytes:
        return orjson.dumps({"announced": self._announced, "now": now})

    def _append(
        self, topic: str, encoding: str, data: bytes, received_ns: int, tick: int = 0, sequence: int = 0
    ) -> None:
        if self._file.closed:
            raise LogError(f"{self._path}: the log is closed, got an entry of {topic}")
        log_ns = min(max(tick * self._period_ns, 0), LAST_TIME_NS)
        received_ns = min(max(received_ns, 0), LAST_TIME_NS)
        with self._guarded():
            self._file.finish_old(received_ns)
            if not self._file.pending and self._announced and topic != TOKENS:  # a damaged chunk costs no other
                self._file.append(Entry(TOKENS, TOKENS_ENCODING, self._tokens(), 0, received_ns, 0))
            self._file.append(Entry(topic, encoding, data, log_ns, received_ns, sequence % SEQUENCES))

    def flush(self) -> None:
        """Write all messages to the file, for live readers and against kills.

        Raises: LogError: the file cannot be written.
        """
        if not self.is_up_to_date:
            with self._guarded():
                self._file.flush()

    def close(self) -> None:
        """Write the index and close the file; a second time, or after a failure, does nothing.

        Raises: LogError: the file cannot be written.
        """
        with self._guarded():
            self._file.close()

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Turn a failed write into a LogError."""
        try:
            yield
        except OSError as error:
            raise LogError(f"{self._path}: cannot write the log ({error.strerror or error})") from error


def read_log(path: Path, *, horizons: bool = True, setup: Setup | None = None) -> RunLog:
    """Read all that can be read of a log, each message checked as by a receiver of the run (`LogReception`).

    A file cut or damaged anywhere behind its first bytes gives the messages of every intact chunk and a sentence in
    `cut`. Messages equal the sent ones bit for bit.

    Args:
        path: The file.
        horizons: Keep whole plans. Otherwise plans have their first step only and no corrections, which saves most of
            the memory.
        setup: The run, if it is known already; otherwise it is taken from the header of the log.
    Raises: LogError: no such file, not an MCAP file, or not the log of a run.
    """
    messages: list[Recorded] = []
    unknown: list[str] = []  # descriptions

    def keep(read: Iterator[Read], received_ns: int) -> None:
        for message, _ in read:
            if not horizons and isinstance(message, Plan):
                message = replace(message, inputs=message.inputs[:1].copy(), corrections=message.corrections[:0])
            messages.append(Recorded(message=message, received_ns=received_ns))

    try:
        with path.open("rb") as file:
            salvage = Salvage(file)
            reception: LogReception | None = None
            received_ns = 0
            for channel, entry in salvage.entries():
                if not is_known(channel):
                    unknown.append(f"a channel {channel.topic!r} with encoding {channel.message_encoding!r}")
                    continue
                if reception is None:
                    setup = setup or setup_in(salvage.metadata.get(METADATA, {}), path.parent)
                    reception = LogReception(setup)
                received_ns = entry.publish_time
                try:
                    keep(reception.read(channel.topic, entry.data, received_ns, salvage.damaged), received_ns)
                except MessageError as error:
                    unknown.append(f"{channel.topic}: {error}")
            if reception is not None:
                keep(reception.close(), received_ns)
    except OSError as error:
        raise LogError(f"{path}: cannot read the log ({error.strerror or error})") from error
    except NotMcapError as error:
        raise LogError(f"{path}: {error}") from error
    header = salvage.metadata.get(METADATA)
    if header is None and salvage.ended and not salvage.damaged:
        raise LogError(f'{path}: an MCAP file, but not the log of a run (no metadata record "{METADATA}")')
    return RunLog(header=header or {}, messages=tuple(messages), cut=_cut(messages, unknown, salvage))


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
    return f"the log is incomplete ({'; '.join(problems)}): {readable}"
