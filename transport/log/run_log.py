"""The log of a run in memory, read from its file or its run folder (`transport.log.writer` describes the file)."""

import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar, cast

import msgspec

from protocol.admission.gate import Gate
from protocol.scenario.file import ScenarioError, validate
from protocol.scenario.setup import Setup
from protocol.wire.codec import decode
from protocol.wire.errors import TransportError
from protocol.wire.keys import RECORDER
from protocol.wire.messages import Message, MessageError, Plan
from transport.log.channels import KEYS, METADATA, OWN, is_known
from transport.log.parser import Parser, UnreadableError

M = TypeVar("M", bound=Message)


class LogError(TransportError, RuntimeError):
    """A log that cannot be read or written; the text names the file and the reason."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    """A message as it was sent, and the wall-clock time at which the recorder received it, ns since 1970."""

    message: Message
    received_ns: int


@dataclass(frozen=True, kw_only=True)
class RunLog:
    """Content of a log."""

    header: dict[str, str]  # metadata of the run: run_id, scenario (TOML), versions, machine, ...
    messages: tuple[Recorded, ...]  # in the order they were received
    cut: str  # sentence about what is missing; empty for a complete log

    @cached_property
    def _by_kind(self) -> dict[type[Message], list[Recorded]]:
        found: dict[type[Message], list[Recorded]] = {}
        for entry in self.messages:
            found.setdefault(type(entry.message), []).append(entry)
        return found

    def of(self, kind: type[M]) -> Iterator[M]:
        """Yield the messages of one kind, in order."""
        return (cast("M", entry.message) for entry in self._by_kind.get(kind, ()))

    def received_ns(self, kind: type[Message]) -> dict[int, int]:
        """Return when the first message of one kind was received at each tick, ns since 1970."""
        times: dict[int, int] = {}
        for entry in self._by_kind.get(kind, ()):
            times.setdefault(entry.message.tick, entry.received_ns)
        return times


class LogReception:
    """Reading the entries of one log, in their order, as a receiver of the run would have read them when they came.

    The log holds what came, also what was forged, repeated or garbled. Every message passes the gate of the run,
    without checks of the moment. Refused ones are counted and reported in the name of the recorder.

    Without the setup of the run, sizes, agents and plausibility are not checked.
    """

    def __init__(self, setup: Setup | None) -> None:
        # The log of an in-memory run has no bundles.
        shape = None if setup is None else replace(setup.shape, relayed=False)
        self._gate = Gate(RECORDER, KEYS, shape)

    def read(self, topic: str, data: bytes, at_ns: int) -> Iterator[Message]:
        """Yield the messages of an entry that arrived at a time, ns.

        Raises: MessageError: the recorder did not write this.
        """
        if topic.startswith(OWN):
            yield decode(data)
        else:
            for message in self._gate.accept(KEYS.prefix + topic, data):
                if isinstance(message, Message):
                    yield message
            yield from self._gate.notices(at_ns, 0)

    def close(self) -> Iterator[Message]:
        """Yield what is to be said at the end of the log."""
        yield from self._gate.last_notices(0)


def setup_in(header: Mapping[str, str], folder: Path) -> Setup | None:
    """Return the run of a log from its header, None if the scenario is missing or of another version.

    Files named in the scenario lie beside the log, in its run folder.
    """
    source = str(folder / "scenario.toml")
    try:
        return Setup.of(validate(tomllib.loads(header.get("scenario", "")), source), source)
    except (ScenarioError, tomllib.TOMLDecodeError):
        return None


def read_log(path: Path, *, horizons: bool = True, setup: Setup | None = None) -> RunLog:
    """Read all that can be read of a log, each message checked as by a receiver of the run (`LogReception`).

    A file cut or damaged anywhere behind its first bytes gives the messages of every intact chunk and a sentence in
    `cut`. Messages equal the sent ones bit for bit.

    Args:
        path: The file.
        horizons: Keep whole plans. Otherwise plans have their first step only and no corrections, which saves most of
            the memory.
        setup: The run, if it is known already; otherwise it is taken from the header of the log.
    Raises: LogError: no such file, not an MCAP file, one that would become too large, or not the log of a run.
    """
    messages: list[Recorded] = []
    unknown: list[str] = []  # descriptions
    parser = Parser(path)

    def keep(read: Iterator[Message], received_ns: int) -> None:
        for message in read:
            if not horizons and isinstance(message, Plan):
                message = msgspec.structs.replace(
                    message, inputs=message.inputs[:1].copy(), corrections=message.corrections[:0]
                )
            messages.append(Recorded(message=message, received_ns=received_ns))

    reception: LogReception | None = None
    with reading(path):
        for channel, data, received_ns in parser.entries():
            if not is_known(channel):
                unknown.append(f"a channel {channel.topic!r} with encoding {channel.message_encoding!r}")
                continue
            if reception is None:
                reception = LogReception(setup or setup_in(parser.metadata.get(METADATA, {}), path.parent))
            try:
                keep(reception.read(channel.topic, data, received_ns), received_ns)
            except MessageError as error:
                unknown.append(f"{channel.topic}: {error}")
        if reception is not None:
            keep(reception.close(), received_ns)
        is_whole = parser.is_whole()
    header = parser.metadata.get(METADATA)
    if header is None and is_whole and not parser.damaged:
        raise LogError(f'{path}: an MCAP file, but not the log of a run (no metadata record "{METADATA}")')
    problems = []
    if not is_whole:
        problems.append("only its index is missing" if parser.ended else "it stops before its end")
    if parser.damaged:
        problems.append(f"{parser.damaged} damaged part{'s' if parser.damaged > 1 else ''} left out")
    if unknown:
        problems.append(f"{len(unknown)} entries are not of this version, the first {unknown[0]}")
    cut = ""
    if problems:
        last = max((entry.message.tick for entry in messages), default=None)
        readable = f"{len(messages)} messages are readable, up to tick {last}" if messages else "no message is readable"
        cut = f"the log is incomplete ({'; '.join(problems)}): {readable}"
    return RunLog(header=header or {}, messages=tuple(messages), cut=cut)


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn a failed reading of a file into a LogError."""
    try:
        yield
    except OSError as error:
        raise LogError(f"{path}: cannot read the log ({error.strerror or error})") from error
    except UnreadableError as error:
        raise LogError(f"{path}: {error}") from error
