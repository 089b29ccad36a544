"""The log of a run in memory, read from its file or its run folder (`transport.log.writer` describes the file)."""

import tomllib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar, cast

import msgspec
from mcap.exceptions import McapError

from protocol.admission.gate import Gate
from protocol.scenario.file import ScenarioError, validate
from protocol.scenario.setup import Setup
from protocol.wire.codec import VERSION, decode
from protocol.wire.errors import MessageError, TransportError
from protocol.wire.keys import RECORDER, Keys
from protocol.wire.messages import KINDS, LinkChange, Message, Plan, Target
from transport.log.parser import Parser

# Name of the metadata record that describes the run.
METADATA = "run"
# Encoding of the bytes of messages (docs/protocol.md); a log of another version of the protocol has another.
ENCODING = f"payload-transport/{VERSION}"
# Beginning of the channels of messages that the recorder made; no message from the network can be there.
_OWN = f"/{RECORDER}/"

_KEYS = Keys("log")


def channel_of(message: Message) -> str:
    """Return the channel in which a message is in the log if it came alone."""
    return _OWN + message.kind if message.sender == RECORDER else _KEYS.of(message).removeprefix(_KEYS.prefix)


def topic_of(message: Message) -> str:
    """Return the channel of a message in descriptions and exports; each kind has its own, in bundles or not."""
    match message:
        case LinkChange() | Target():  # share the key of the rosters
            return f"/{message.kind}"
        case Plan(agent=agent):  # has two keys
            return f"/{message.kind}/{agent}"
    return _KEYS.of(message).removeprefix(_KEYS.prefix)


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


class LogTail:
    """Reader of one log, which may still be written, as a receiver of the run would have read it when it came.

    The log holds what came, also what was forged, repeated or garbled. Every message passes the gate of the run,
    without checks of the moment. Refused ones are counted and reported in the name of the recorder. Without the setup
    of the run, which is taken from the header unless given, sizes, agents and plausibility are not checked. The file
    need not exist yet; `read` returns the given kinds of messages.
    """

    def __init__(
        self, path: Path, kinds: Collection[str] | Mapping[str, object] = KINDS, setup: Setup | None = None
    ) -> None:
        self.parser, self.unknown = Parser(path), list[str]()  # descriptions of the entries of other versions
        self._path, self._wanted, self._setup = path, frozenset(kinds), setup
        self._gate: Gate | None = None

    @property
    def ended(self) -> bool:
        """Whether the data section has come to its proper end."""
        return self.parser.ended

    def read(self) -> list[Message]:
        """Return the new messages, in order; a record written only in part waits for the next call.

        Raises: LogError: the file cannot be read.
        """
        if self.ended or not self._path.exists():
            return []
        found = [entry.message for entry in self.entries()]
        if self.ended:
            found += self.last_notices()
        return [message for message in found if message.kind in self._wanted]

    def entries(self) -> Iterator[Recorded]:
        """Yield the messages of the entries that are whole and were not read yet.

        Raises: LogError: as of `read`, or there is no such file.
        """
        try:
            for channel, entry in self.parser.entries():
                if channel.message_encoding != ENCODING:
                    self.unknown.append(f"a channel {channel.topic!r} with encoding {channel.message_encoding!r}")
                    continue
                try:
                    for message in self._accepted(channel.topic, entry.data, entry.publish_time):
                        yield Recorded(message=message, received_ns=entry.publish_time)
                except MessageError as error:
                    self.unknown.append(f"{channel.topic}: {error}")
        except OSError as error:
            raise LogError(f"{self._path}: cannot read the log ({error.strerror or error})") from error
        except McapError as error:
            raise LogError(f"{self._path}: {error}") from error

    def last_notices(self) -> list[Message]:
        """Return what is to be said at the end of the log."""
        return [] if self._gate is None else list(self._gate.notices(0))

    def _accepted(self, topic: str, data: bytes, at_ns: int) -> Iterator[Message]:
        """Yield the messages of an entry that arrived at a time, ns.

        Raises: MessageError: the recorder did not write this.
        """
        if topic.startswith(_OWN):
            yield decode(data)
            return
        if self._gate is None:
            setup = self._setup or setup_in(self.parser.metadata.get(METADATA, {}), self._path.parent)
            # The log of an in-memory run has no bundles.
            self._gate = Gate(RECORDER, _KEYS, None if setup is None else replace(setup.shape, relayed=False))
        for message in self._gate.accept(_KEYS.prefix + topic, data):
            if isinstance(message, Message):
                yield message
        yield from self._gate.notices(0, at_ns)


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
    """Read all that can be read of a log, each message checked as by a receiver of the run (`LogTail`).

    A file cut or damaged anywhere behind its first bytes gives the messages of every intact chunk and a sentence in
    `cut`. Messages equal the sent ones bit for bit. Without `horizons` plans have their first step only and no
    corrections, which saves most of the memory.

    Raises: LogError: no such file, not an MCAP file, or not the log of a run.
    """
    tail = LogTail(path, setup=setup)
    messages: list[Recorded] = []
    for entry in tail.entries():
        plan = entry.message
        if not horizons and isinstance(plan, Plan):
            shortened = {"inputs": plan.inputs[:1].copy(), "corrections": plan.corrections[:0]}
            entry = replace(entry, message=msgspec.structs.replace(plan, **shortened))
        messages.append(entry)
    last_ns = messages[-1].received_ns if messages else 0
    messages += [Recorded(message=notice, received_ns=last_ns) for notice in tail.last_notices()]
    parser, unknown, is_whole = tail.parser, tail.unknown, tail.parser.is_whole()
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
