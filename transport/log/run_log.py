"""The log of a run: every message in one MCAP file that viewers open and that survives a kill.

Messages are JSON, one channel for each key with a schema of its own; `log_time` is scenario time, so that
viewers show the flight and not the host, `publish_time` is when the recorder received the message. What
belongs to the run as a whole is in the metadata record "run", ahead of all messages.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import orjson

from protocol.wire.keys import Keys
from protocol.wire.messages import KINDS, Control, FaultNote, LinkChange, Message, Plan
from transport.log.json_messages import from_json, json_schema, to_json
from transport.log.mcap_stream import McapStream
from transport.log.salvage import NotMcapError, Salvage

# What a kill costs at most: so much before compression, about three ticks of four agents, or so long, whatever is less.
# Larger chunks would hardly be smaller together; later ones would keep who watches a run in real time waiting.
CHUNK_BYTES = 64 * 1024
CHUNK_S = 0.03
_CHUNK_NS = round(CHUNK_S * 1e9)

_METADATA = "run"
# The metadata record of a copy that names the channels it has more than the log: made from its messages, none of them.
DERIVED = "derived channels"
_KEYS = Keys("log")
_LAST_TIME_NS = 2**63 - 1
_SEQUENCES = 2**32  # the format counts with 32 bits; the message itself has all of them

M = TypeVar("M", bound=Message)


class LogError(RuntimeError):
    """A log that cannot be written or is none; the text names the file and the reason."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    """A message and when the recorder received it.

    Attributes:
        message: As it was sent.
        received_ns: Wall-clock time, ns since 1970.
    """

    message: Message
    received_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RunLog:
    """What a log holds.

    Attributes:
        header: The run as a whole: run_id, scenario (TOML), versions, machine, ...
        messages: In the order they were received.
        cut: Empty for a log that is complete; otherwise a sentence about what is lost.
    """

    header: dict[str, str]
    messages: tuple[Recorded, ...]
    cut: str

    def of(self, kind: type[M]) -> Iterator[M]:
        """The messages of one kind, in order."""
        return (entry.message for entry in self.messages if isinstance(entry.message, kind))

    def received_ns(self, kind: type[Message]) -> dict[int, int]:
        """When the message of one kind was received, by tick; the first one where a tick has several."""
        times: dict[int, int] = {}
        for entry in self.messages:
            if isinstance(entry.message, kind):
                times.setdefault(entry.message.tick, entry.received_ns)
        return times


class LogWriter:
    """Writes the log of one run. At any moment the file can be read; a kill costs the last chunk at most.

    Args:
        path: File to create.
        header: What belongs to the run as a whole; keys and values are for `read_log` to give back.
        period_ns: Sampling period, ns: turns ticks into time.
    Raises: LogError: the file cannot be written.
    """

    def __init__(self, path: Path, header: Mapping[str, str], *, period_ns: int) -> None:
        self._path = path
        self._period_ns = period_ns
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._oldest_ns = 0  # when the first message came that is not in the file yet
        self._closed = False
        try:
            self._stream = McapStream(path, library="payload-transport", chunk_bytes=CHUNK_BYTES)
        except OSError as error:
            raise self._failed(error) from error
        try:
            self._stream.metadata(_METADATA, header)
        except OSError as error:
            raise self._abandoned(error) from error

    def __enter__(self) -> "LogWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write(self, message: Message, received_ns: int) -> None:
        """Append a message.

        Args:
            message: Of any kind.
            received_ns: Wall-clock time of its arrival, ns since 1970.
        Raises: LogError: the file cannot be written, or is closed.
        """
        if self._closed:
            raise LogError(f"{self._path}: the log is closed, got a {message.kind}")
        data = to_json(message)
        try:
            if received_ns - self._oldest_ns > _CHUNK_NS:
                self._stream.flush()
            if self._stream.is_up_to_date:
                self._oldest_ns = received_ns
            self._stream.message(
                self._channel(message),
                log_time=min(message.tick * self._period_ns, _LAST_TIME_NS),
                publish_time=min(max(received_ns, 0), _LAST_TIME_NS),
                sequence=message.sequence % _SEQUENCES,
                data=data,
            )
            if isinstance(message, Control | FaultNote):
                self._stream.flush()  # how the run ended, and what was done to it, is not left to the closing
        except OSError as error:
            raise self._abandoned(error) from error

    def flush(self) -> None:
        """Have all messages in the file: for who reads it meanwhile, and against kills.

        Raises: LogError: the file cannot be written.
        """
        if self._closed:
            return
        try:
            self._stream.flush()
        except OSError as error:
            raise self._abandoned(error) from error

    @property
    def is_up_to_date(self) -> bool:
        """Whether all messages are in the file."""
        return self._closed or self._stream.is_up_to_date

    def close(self) -> None:
        """Write the index and close the file; a second time, or after a failure, does nothing.

        Raises: LogError: the file cannot be written.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._stream.finish()
        except OSError as error:
            raise self._abandoned(error) from error

    def _channel(self, message: Message) -> int:
        topic = topic_of(message)
        channel = self._channels.get(topic)
        if channel is None:
            if message.kind not in self._schemas:
                data = orjson.dumps(json_schema(message.kind))
                self._schemas[message.kind] = self._stream.schema(
                    f"transport.{type(message).__name__}", "jsonschema", data
                )
            channel = self._stream.channel(topic, "json", self._schemas[message.kind])
            self._channels[topic] = channel
        return channel

    def _abandoned(self, error: OSError) -> LogError:
        """Leave the file as it is: behind half a record nobody would find another."""
        self._closed = True
        self._stream.abandon()
        return self._failed(error)

    def _failed(self, error: OSError) -> LogError:
        return LogError(f"{self._path}: cannot write the log ({error.strerror or error})")


def topic_of(message: Message) -> str:
    """The channel of a message: each kind has its own, whatever keys it travels under."""
    match message:
        case LinkChange():  # under the key of the rosters
            return f"/{message.kind}"
        case Plan(agent=agent):  # under one of two keys
            return f"/{message.kind}/{agent}"
    return _KEYS.of(message).removeprefix(_KEYS.prefix)


def read_log(path: Path, *, horizons: bool = True) -> RunLog:
    """Read a log, as much of it as there is.

    A file cut at any byte, or damaged behind its first bytes, gives the messages of every intact chunk and a
    sentence in `cut`. Messages equal the written ones bit for bit.

    Args:
        path: The file.
        horizons: Whether plans are wanted as they are. Otherwise they have their first step alone, without corrections:
            the rest is most of what is in a log.
    Raises: LogError: no such file, not an MCAP file, or not the log of a run.
    """
    messages: list[Recorded] = []
    foreign: list[tuple[str, str]] = []
    try:
        with path.open("rb") as file:
            found = Salvage(file)
            for topic, entry in found.entries():
                kind = topic.lstrip("/").split("/", 1)[0]
                if kind not in KINDS:
                    foreign.append((topic, f"a channel {topic!r}"))
                    continue
                try:
                    message = from_json(kind, entry.data)
                    if not horizons and isinstance(message, Plan):
                        message = _first_step(message)
                except (ValueError, TypeError) as error:
                    foreign.append((topic, f"{kind}: {error}"))
                    continue
                messages.append(Recorded(message=message, received_ns=entry.publish_time))
    except OSError as error:
        raise LogError(f"{path}: cannot read the log ({error.strerror or error})") from error
    except NotMcapError as error:
        raise LogError(f"{path}: {error}") from error
    header = found.metadata.get(_METADATA)
    if header is None and found.ended and not found.damaged:
        raise LogError(f'{path}: an MCAP file, but not the log of a run (no metadata record "{_METADATA}")')
    derived = found.metadata.get(DERIVED, {})
    unknown = [text for topic, text in foreign if topic not in derived]
    return RunLog(header=header or {}, messages=tuple(messages), cut=_cut(messages, unknown, found))


def _first_step(plan: Plan) -> Plan:
    """A plan of one step."""
    return replace(plan, inputs=plan.inputs[:1].copy(), corrections=plan.corrections[:0].copy())


def _cut(messages: list[Recorded], foreign: list[str], found: Salvage) -> str:
    """What is missing, in a sentence; empty for a whole log."""
    problems = []
    if not found.ended:
        problems.append("only its index is missing" if found.data_ended else "it stops before its end")
    if found.damaged:
        problems.append(f"{found.damaged} damaged part{'s' if found.damaged > 1 else ''} left out")
    if foreign:
        problems.append(f"{len(foreign)} entries are not of this version, the first {foreign[0]}")
    if not problems:
        return ""
    last = max((entry.message.tick for entry in messages), default=None)
    readable = "no message is readable" if last is None else f"{len(messages)} messages are readable, up to tick {last}"
    return f"the log is not whole ({'; '.join(problems)}): {readable}"
