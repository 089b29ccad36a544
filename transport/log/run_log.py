"""The log of a run in memory, read from its file or its run folder (`transport.log.writer` describes the file)."""

import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TypeVar, cast

import msgspec
from mcap.exceptions import McapError

from transport.log.parser import Parser
from transport.protocol.admission.gate import Gate
from transport.protocol.scenario.file import ScenarioError, read_scenario, validate
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire import messages as wire
from transport.protocol.wire.codec import VERSION, decode
from transport.protocol.wire.errors import MessageError, TransportError
from transport.protocol.wire.keys import RECORDER, Keys
from transport.protocol.wire.messages import LinkChange, Message, Plan, Target
from transport.protocol.wire.names import COORDINATOR

METADATA = "run"  # name of the metadata record that describes the run
ENCODING = f"payload-transport/{VERSION}"  # of the bytes of messages; each version of the protocol has another
_OWN = f"/{RECORDER}/"  # beginning of the channels of messages that the recorder made; none comes from the network

_KEYS = Keys("log")


def channel_of(message: Message) -> str:
    """Return the channel in which a message is in the log if it came alone."""
    return (
        _OWN + message.kind
        if message.sender == RECORDER
        else _KEYS.of(message).removeprefix(_KEYS.prefix)
    )


def topic_of(message: Message) -> str:
    """Return the channel of a message in descriptions and exports.

    Each kind has its own, in bundles or not.
    """
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
    """Reader of one log, which may still be written or not exist yet.

    Every message passes the gate of the run, whose setup is taken from the header unless given;
    refused ones are reported in the name of the recorder.
    """

    def __init__(self, path: Path, setup: Setup | None = None) -> None:
        self.parser, self.unknown = (
            Parser(path),
            list[str](),
        )  # descriptions of the entries of other versions
        self._path, self._setup = path, setup
        self._gate: Gate | None = None

    @property
    def ended(self) -> bool:
        """Whether the data section has come to its proper end."""
        return self.parser.ended

    def read(self) -> list[Message]:
        """Return the new messages, in order; a record written only in part waits for the next call."""
        if self.ended or not self._path.exists():
            return []
        found = [entry.message for entry in self.entries()]
        return found + self.last_notices() if self.ended else found

    def entries(self) -> Iterator[Recorded]:
        """Yield the messages of the entries that are whole and were not read yet.

        Raises: LogError: no such file.
        """
        try:
            for channel, entry in self.parser.entries():
                if channel.message_encoding != ENCODING:
                    self.unknown.append(
                        f"a channel {channel.topic!r} with encoding {channel.message_encoding!r}"
                    )
                    continue
                try:
                    for message in self._accepted(channel.topic, entry.data, entry.publish_time):
                        yield Recorded(message=message, received_ns=entry.publish_time)
                except MessageError as error:
                    self.unknown.append(f"{channel.topic}: {error}")
        except OSError as error:
            raise LogError(
                f"{self._path}: cannot read the log ({error.strerror or error})"
            ) from error
        except McapError as error:
            raise LogError(f"{self._path}: {error}") from error

    def last_notices(self) -> list[Message]:
        """Return what is to be said at the end of the log."""
        return [] if self._gate is None else list(self._gate.notices(0))

    def _accepted(self, topic: str, data: bytes, at_ns: int) -> Iterator[Message]:
        """Yield the messages of an entry that arrived at a time, ns."""
        if topic.startswith(_OWN):
            yield decode(data)
            return
        if self._gate is None:
            setup = self._setup or setup_in(
                self.parser.metadata.get(METADATA, {}), self._path.parent
            )
            # The log of an in-memory run has no bundles.
            self._gate = Gate(
                RECORDER, _KEYS, None if setup is None else replace(setup.shape, relayed=False)
            )
        for message in self._gate.accept(_KEYS.prefix + topic, data):
            if isinstance(message, Message):
                yield message
        yield from self._gate.notices(0, at_ns)


def setup_in(header: Mapping[str, str], folder: Path) -> Setup | None:
    """Return the run of a log from its header, None if the scenario is missing or of another version."""
    source = str(folder / "scenario.toml")
    try:
        return Setup.of(validate(tomllib.loads(header.get("scenario", "")), source), source)
    except (ScenarioError, tomllib.TOMLDecodeError):
        return None


def read_log(path: Path, *, horizons: bool = True, setup: Setup | None = None) -> RunLog:
    """Read all that can be read of a log, also of one cut or damaged (`cut`), each message checked (`LogTail`).

    Without `horizons` plans have their first step only and no corrections, which saves most of the
    memory.
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
        raise LogError(
            f'{path}: an MCAP file, but not the log of a run (no metadata record "{METADATA}")'
        )
    problems = (
        []
        if is_whole
        else ["only its index is missing" if parser.ended else "it stops before its end"]
    )
    problems += [f"damaged parts left out: {parser.damaged}"] if parser.damaged else []
    problems += (
        [f"{len(unknown)} entries are not of this version, the first {unknown[0]}"]
        if unknown
        else []
    )
    last = f", up to tick {max(entry.message.tick for entry in messages)}" if messages else ""
    readable = f"{len(messages) or 'no'} messages are readable{last}"
    cut = f"the log is incomplete ({'; '.join(problems)}): {readable}" if problems else ""
    return RunLog(header=header or {}, messages=tuple(messages), cut=cut)


_RUNS, LATEST = (
    "runs",
    "latest",
)  # folder whose runs have a link to the most recent one, and the name of the link


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedRun:
    """A recorded run."""

    folder: Path
    setup: Setup
    log: RunLog  # `cut` names what the file lacks and what did not reach the recorder

    @property
    def scenario_file(self) -> Path:
        """Path of the scenario of the run, with every default."""
        return self.folder / "scenario.toml"


def open_run(folder: Path, *, horizons: bool = True, setup: Setup | None = None) -> RecordedRun:
    """Read run.mcap of a run folder, as `read_log`, and the run from scenario.toml, or raise ScenarioError."""
    path = folder / "run.mcap"
    if setup is None and path.exists():  # otherwise the folder is none of a run, which says more
        setup = setup_of(folder)
    log = read_log(path, horizons=horizons, setup=setup)
    cut = "; ".join(filter(None, (log.cut, missing(log))))
    return RecordedRun(folder=folder, setup=setup or setup_of(folder), log=replace(log, cut=cut))


def setup_of(folder: Path) -> Setup:
    """Return the run of a folder without reading its log, or raise ScenarioError."""
    path = folder / "scenario.toml"
    return Setup.of(read_scenario(path, allow_large=True), str(path))  # its run has been allowed


def missing(log: RunLog) -> str:
    """Return a sentence with the ticks between which messages are missing; empty if none is.

    Every process numbers its messages; ticks after the last plant state are known from other
    messages.
    """
    # The recorder's own notes cannot get lost; rejections have numbers of their own.
    messages = [
        entry.message for entry in log.messages if not isinstance(entry.message, wire.Rejected)
    ]
    ticks: dict[tuple[str, int], dict[int, int]] = {}  # by sender and incarnation, then by number
    for message in (message for message in messages if message.sender != RECORDER):
        ticks.setdefault((message.sender, message.incarnation), {-1: 0})[message.sequence] = (
            message.tick
        )
    gaps = [
        tick_of[number]
        for tick_of in ticks.values()
        for pair in pairwise(sorted(tick_of))
        for number in pair
        if pair[1] > pair[0] + 1
    ]
    recorded = max((plant_state.tick for plant_state in log.of(wire.PlantState)), default=-1)
    # The plant measures at a tick after simulating the one before.
    later = [
        message.tick - 1
        for message in messages
        if isinstance(message, wire.Measurement | Plan | wire.StepReport)
    ]
    later += [
        end.tick
        for end in log.of(wire.Control)
        if end.outcome == "completed" and end.sender == COORDINATOR
    ]
    gaps += [recorded + 1, max(later)] if max(later, default=-1) > recorded else []
    return (
        f"some messages of ticks {min(gaps)} to {max(gaps)} did not reach the recorder"
        if gaps
        else ""
    )


def point_latest(folder: Path) -> None:
    """Point `latest` beside a run folder at it, if both are in a folder named `runs` and nothing else has that name."""
    link = folder.parent / LATEST
    if folder.resolve().parent.name == _RUNS and folder.name != LATEST:
        with suppress(OSError):
            if link.is_symlink():
                link.unlink()
            link.symlink_to(folder.name, target_is_directory=True)
