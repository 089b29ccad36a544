"""The coordinator in scripted transcripts: events in, messages and states out.

`python -m pytest tests/coordinator/test_transcripts.py --rewrite` renews the files; a change of one is a
change of behaviour and belongs into a review. A file is a list of blocks, each with a coordinator of its
own, four agents, and a run of three ticks of 50 ms:

    [NAME] or [NAME from OTHER]      a block, which goes on where another of the file has ended
    run SETTINGS                     a new coordinator; settings as of `--set`
    at MS                            the time of the events that follow, ms after tick 0
    ready NAMES, gone NAMES          tokens, such as agent2 or agent2.3 in incarnation 3
    plans TICK AGENTS                the agents' answers to a tick; `proposals TICK LEFT AGENTS`; 3- is not shared
    plant TICK [REASON]              the plant's state, diverged for a reason
    poll, interrupt, status          as named; `wake` tells when the next poll is due
    link KEY=VALUE ...               a request of a change of links

An indented line is what follows: a message, or a state that the run goes to.
"""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from tests.support.coordinator_clock import MS, START_NS, THREE, gone, ready
from tests.support.nodes import CoordinatorNode, refused
from tests.support.runs import ALL, INCARNATION, plan, plant_state, setup
from transport.coordinator.state_machine import TRANSITIONS, Cause, Machine, MachineError, State
from transport.protocol.wire.messages import (
    Control,
    Event,
    LinkChange,
    Message,
    Request,
    Roster,
    Tick,
)
from transport.protocol.wire.names import agent_name

FOLDER = Path(__file__).parent / "transcripts"
FILES = sorted(FOLDER.glob("*.txt"))
# The one who takes part of whom a block says "all": every process that the first tick waits for.
EVERYONE = ("plant", *map(agent_name, ALL))


class Session:
    """A coordinator to which the commands of a block happen."""

    def __init__(self) -> None:
        self._settings: list[str] = []
        self._now_ns = START_NS
        self._node: CoordinatorNode
        self._run([])

    def obey(self, command: str) -> Iterator[str]:
        """Execute a command; yield the lines that follow from it."""
        what, *words = command.split()
        before = self._node.state
        refusals = sum(count for _, _, count in refused(self._node))
        match what:
            case "run":
                self._run(words)
                return
            case "at":
                self._now_ns = START_NS + round(float(words[0]) * MS)
                return
            case "wake":
                wake_ns = self._node.wake_ns
                yield "never" if wake_ns is None else f"at {(wake_ns - START_NS) / MS:g} ms"
                return
            case "poll":
                messages = list(self._node.poll(self._now_ns))
            case "interrupt":
                messages = list(self._node.interrupt("Ctrl-C"))
            case _:
                messages = []
                for event in self._events(what, words):
                    messages += self._node.receive(event, self._now_ns)
                    if isinstance(event, Request):
                        yield f"answer {json.dumps(self._answers.pop())}"
        if sum(count for _, _, count in refused(self._node)) > refusals:
            yield f"refused: {refused(self._node)[-1][1]}"
        yield from map(line_of, messages)
        if self._node.state is not before:
            yield self._node.state.name

    def _run(self, settings: list[str]) -> None:
        self._settings = [THREE, *settings]
        self._node = CoordinatorNode(setup(*self._settings))
        self._answers: list[Any] = []

    def _events(self, what: str, words: list[str]) -> Iterable[Event]:
        """Return the events of a command."""
        match what:
            case "ready" | "gone":
                event = ready if what == "ready" else gone
                return [event(*named(word)) for word in (EVERYONE if words == ["all"] else words)]
            case "plans":
                tick, *agents = words
                return [self._plan(word, int(tick)) for word in (agents or map(str, ALL))]
            case "proposals":
                tick, left, *agents = words
                plans = [self._plan(word, int(tick)) for word in (agents or map(str, ALL))]
                return [replace(proposal, negotiation=int(left)) for proposal in plans]
            case "plant":
                tick, *reason = words
                return [plant_state(setup(*self._settings), int(tick), " ".join(reason))]
            case "status":
                return [Request("status", {}, self._answers.append)]
            case "link":
                given = dict(word.split("=", 1) for word in words)
                settings = {
                    key: json.loads(value)
                    for key, value in given.items()
                    if key not in ("from", "to")
                }
                ends = {key: value for key, value in given.items() if key in ("from", "to")}
                return [Request("link", {**ends, "settings": settings}, self._answers.append)]
        raise ValueError(what)

    def _plan(self, word: str, tick: int) -> Message:
        """Return an agent's plan, such as of agent 2 or of 2.3, in incarnation 3."""
        agent, _, incarnation = word.rstrip("-").partition(".")
        run = setup(*self._settings)
        return plan(
            run,
            int(agent),
            tick,
            delay=int(run.scenario.clock.next_tick),
            incarnation=int(incarnation or INCARNATION),
            shared=not word.endswith("-"),
        )


def named(word: str) -> tuple[str, int]:
    """Return name and incarnation of a process, such as agent2 or agent2.3."""
    name, _, incarnation = word.partition(".")
    return name, int(incarnation or INCARNATION)


def line_of(message: Message) -> str:
    """Return a message as a line."""
    match message:
        case Roster():
            incarnations = zip(message.agents, message.incarnations, strict=True)
            team = " ".join(f"{agent}.{incarnation}" for agent, incarnation in incarnations)
            off = "".join(f", UAV{uav} off" for uav in message.off)
            off += "".join(f", UAV{uav} released" for uav in message.released)
            head = f"roster {message.version} of tick {message.tick}: {team}{off}"
            return f"{head}  ({message.reason})"
        case Tick():
            answered = " ".join(map(str, message.answered)) or "none"
            if message.shared != message.answered:
                answered += f", shared by {' '.join(map(str, message.shared))}"
            late = f", {message.late_ns / MS:g} ms late" if message.late_ns else ""
            overrun = f", a plan {message.overrun_ns / MS:g} ms" if message.overrun_ns > 0 else ""
            members = " ".join(map(str, message.members))
            return (
                f"tick {message.tick}: {members}, roster {message.roster}, "
                f"answered before by {answered}{late}{overrun}"
            )
        case LinkChange():
            ends = f"{message.source or 'any'} to {message.target or 'any'}"
            return f"link {message.number} of tick {message.tick}: {ends} {message.settings}"
        case Control():
            return (
                f"end at tick {message.tick}: {message.outcome}, exit code {message.exit_code}"
                + (f"  ({message.reason})" if message.reason else "")
            )
    return f"{message.kind} of tick {message.tick}"


def transcript(text: str) -> str:
    """Return a transcript with the lines that really follow from its commands."""
    blocks: dict[str, list[str]] = {}  # commands, with those of the blocks they go on from
    session = Session()
    written: list[str] = []
    commands: list[str] = []
    for line in text.splitlines():
        if line.startswith("["):
            name, _, origin = line.strip("[]").partition(" from ")
            commands = list(blocks[origin]) if origin else []
            blocks[name] = commands
            session = Session()
            for command in commands:
                list(session.obey(command))
        if line.startswith(("[", "#")) or not line:
            written.append(line)
        elif not line.startswith(" "):
            commands.append(line)
            written += [line, *(f"    {found}".rstrip() for found in session.obey(line))]
    return "\n".join([*written, ""])


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_the_coordinator_does_as_written(file: Path, request: pytest.FixtureRequest) -> None:
    """Each event of a transcript has the consequences that the transcript says (docs/time.md)."""
    text = file.read_text(encoding="utf-8")
    found = transcript(text)
    if request.config.getoption("--rewrite"):
        file.write_text(found, encoding="utf-8")
    assert found == file.read_text(encoding="utf-8"), f"{file.name}: renew it with --rewrite"


def test_transcripts_show_each_transition_without_vehicles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each pair of the table is in a transcript, but for those of vehicles (`test_fleet.py`)."""
    seen: set[tuple[State, Cause]] = set()
    move = Machine.move

    def noted(machine: Machine, cause: Cause) -> bool:
        seen.add((machine.state, cause))
        return move(machine, cause)

    monkeypatch.setattr(Machine, "move", noted)
    for file in FILES:
        transcript(file.read_text(encoding="utf-8"))
    of_vehicles = {State.PREPARING, State.STARTING}
    expected = {
        (state, cause)
        for state, causes in TRANSITIONS.items()
        for cause in causes
        if state not in of_vehicles
    }
    assert expected - seen == {
        # Only with vehicles.
        (State.WAITING, Cause.JOINED),
        (State.WAITING, Cause.PLANT_ENDS),
        # A contact after a divergence.
        (State.ENDING, Cause.PLANT_ENDS),
    }


@pytest.mark.parametrize("state", State)
def test_each_state_ends(state: State) -> None:
    """A run can be ended in any state, and nothing but its end follows from that of the plant."""
    if state is State.STOPPED:
        assert not TRANSITIONS[state]
        return
    assert TRANSITIONS[state][Cause.ENDED] is State.STOPPED
    assert set(TRANSITIONS[State.ENDING].values()) == {State.ENDING, State.STOPPED}


def test_a_cause_that_cannot_be_is_a_defect() -> None:
    """A tick that is held before any was open is refused with both, and the state stays."""
    machine = Machine()
    with pytest.raises(MachineError, match="AWAITED in WAITING: agents are to return"):
        machine.move(Cause.AWAITED)
    assert machine.state is State.WAITING
