"""Log of a run in memory, read from its file, also while it is being written.

`transport.log.writer` describes the file, `transport.log.run_folder` opens the folder of a run.
"""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar, cast

import msgspec
from mcap.exceptions import McapError

from transport.log.parser import Parser
from transport.protocol.admission.acceptance_and_refusals import Gate
from transport.protocol.scenario.radio.radio_parameters import PlanShape
from transport.protocol.scenario.scenario_file import ScenarioError, validate
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import VERSION, decode
from transport.protocol.wire.errors_and_exit_codes import MessageError, TransportError
from transport.protocol.wire.key_expressions import RECORDER, Keys
from transport.protocol.wire.messages import LinkChange, Message, Plan, Target

METADATA = "run"  # name of the metadata record that describes the run
# Encoding of the bytes of messages; each version of the protocol has another.
ENCODING = f"payload-transport/{VERSION}"
# Beginning of the channels of messages that the recorder made; none comes from the network.
_OWN = f"/{RECORDER}/"

_KEYS = Keys("log")


def channel_of(message: Message) -> str:
    """Return the channel in which a message is in the log if it came alone."""
    if message.sender == RECORDER:
        return _OWN + message.kind
    return _KEYS.of(message).removeprefix(_KEYS.prefix)


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
    """A message as it was sent, and when the recorder received it."""

    message: Message
    received_ns: int  # wall-clock time, ns since 1970


@dataclass(frozen=True, kw_only=True)
class RunLog:
    """Content of a log."""

    header: dict[str, str]  # metadata of the run: run_id, scenario (TOML), versions, machine, ...
    messages: tuple[Recorded, ...]  # in the order they were received
    cut: str  # sentence about what is missing; empty for a complete log
    # Holds the plans as they were sent, where those in `messages` are shortened.
    plans_sent: PlanShape = field(default_factory=PlanShape)

    @cached_property
    def _by_kind(self) -> dict[type[Message], list[Recorded]]:
        entries: dict[type[Message], list[Recorded]] = {}
        for entry in self.messages:
            entries.setdefault(type(entry.message), []).append(entry)
        return entries

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
        self.parser = Parser(path)
        self.unknown = 0  # entries of other versions
        self.first_unknown = ""  # description of the first of them
        self.newest_ns = 0  # wall-clock time at which the newest entry was recorded; 0 before
        self._path = path
        self._setup = setup
        self._gate: Gate | None = None

    @property
    def ended(self) -> bool:
        """True once the data section has come to its proper end."""
        return self.parser.ended

    def read(self) -> list[Message]:
        """Return the new messages, in order; one written only in part waits for the next call."""
        messages = [entry.message for entry in self.read_recorded()]
        if self.ended:
            messages += self.last_notices()
        return messages

    def read_recorded(self) -> list[Recorded]:
        """Return the new messages, with the times at which they were recorded."""
        if self.ended or not self._path.exists():
            return []
        return list(self.entries())

    def entries(self) -> Iterator[Recorded]:
        """Yield the messages of the entries that are whole and were not read yet.

        Raises: LogError: no such file.
        """
        try:
            for channel, entry in self.parser.entries():
                self.newest_ns = max(entry.publish_time, self.newest_ns)
                encoding = channel.message_encoding
                if encoding != ENCODING:
                    self._pass_over(f"a channel {channel.topic!r} with encoding {encoding!r}")
                    continue

                try:
                    for message in self._accepted(channel.topic, entry.data, entry.publish_time):
                        yield Recorded(message=message, received_ns=entry.publish_time)
                except MessageError as error:
                    self._pass_over(f"{channel.topic}: {error}")
        except OSError as error:
            reason = error.strerror or error
            raise LogError(f"{self._path}: cannot read the log ({reason})") from error
        except McapError as error:
            raise LogError(f"{self._path}: {error}") from error

    def _pass_over(self, description: str) -> None:
        """Count an entry of another version; the first one is described."""
        self.unknown += 1
        self.first_unknown = self.first_unknown or description

    def last_notices(self) -> list[Message]:
        """Return the notices of the gate at the end of the log."""
        return [] if self._gate is None else list(self._gate.notices(0))

    def _accepted(self, topic: str, data: bytes, received_ns: int) -> Iterator[Message]:
        """Yield the messages of an entry that arrived at a time, ns."""
        if topic.startswith(_OWN):
            yield decode(data)
            return

        if self._gate is None:
            self._gate = self._new_gate()
        for accepted in self._gate.accept(_KEYS.prefix + topic, data):
            if isinstance(accepted.message, Message):
                yield accepted.message
        yield from self._gate.notices(0, received_ns)

    def _new_gate(self) -> Gate:
        """Return the gate of the run, without checks against its shape if the run is unknown."""
        setup = self._setup
        if setup is None:
            setup = setup_in(self.parser.metadata.get(METADATA, {}), self._path.parent)
        # The log of an in-memory run has no bundles.
        shape = None if setup is None else replace(setup.rules.shape, relayed=False)
        return Gate(RECORDER, _KEYS, shape)


def setup_in(header: Mapping[str, str], folder: Path) -> Setup | None:
    """Return the run of a log from its header.

    None if the scenario is missing or of another version.
    """
    source = str(folder / "scenario.toml")
    try:
        tree = tomllib.loads(header.get("scenario", ""))
        return Setup.of(validate(tree, source), source)
    except (ScenarioError, tomllib.TOMLDecodeError, RecursionError):
        return None


def read_log(path: Path, *, horizons: bool = True, setup: Setup | None = None) -> RunLog:
    """Read as much of a log as can be read, also of one cut or damaged (`cut`).

    Each message is checked (`LogTail`). Without `horizons` plans have their first step only, no
    corrections and no own data, which saves most of the memory.

    Raises: LogError: no such file, not an MCAP file, or not the log of a run.
    """
    tail = LogTail(path, setup=setup)
    messages = []
    plans_sent = PlanShape()
    for entry in tail.entries():
        if isinstance(entry.message, Plan):
            plans_sent = plans_sent.holding([entry.message])
        messages.append(entry if horizons else _first_step(entry))

    last_ns = messages[-1].received_ns if messages else 0
    messages += [Recorded(message=notice, received_ns=last_ns) for notice in tail.last_notices()]

    problems = _problems(tail)
    header = tail.parser.metadata.get(METADATA)
    if header is None and tail.parser.is_whole() and not tail.parser.damaged:
        problem = f'not the log of a run (no metadata record "{METADATA}")'
        raise LogError(f"{path}: an MCAP file, but {problem}")

    last = f", up to tick {max(entry.message.tick for entry in messages)}" if messages else ""
    readable = f"{len(messages) or 'no'} messages are readable{last}"
    cut = f"the log is incomplete ({'; '.join(problems)}): {readable}" if problems else ""
    return RunLog(header=header or {}, messages=tuple(messages), cut=cut, plans_sent=plans_sent)


def _first_step(entry: Recorded) -> Recorded:
    """Return an entry whose plan, if it is one, has its first step alone, no corrections or data."""
    plan = entry.message
    if not isinstance(plan, Plan):
        return entry

    # A copy: a view would keep the whole horizon in memory.
    inputs = plan.inputs[:1].copy()
    shortened = msgspec.structs.replace(
        plan, inputs=inputs, corrections=plan.corrections[:0], data=plan.data[:0]
    )
    return replace(entry, message=shortened)


def _problems(tail: LogTail) -> list[str]:
    """Return a clause about each part that a log lacks after it was read."""
    problems = []
    if not tail.parser.is_whole():
        missing_end = "only its index is missing" if tail.ended else "it stops before its end"
        problems.append(missing_end)
    if tail.parser.damaged:
        problems.append(f"damaged parts left out: {tail.parser.damaged}")
    if tail.unknown:
        problems.append(
            f"{tail.unknown} entries are not of this version, the first {tail.first_unknown}"
        )
    return problems
