"""One agent of a recorded run, flown again: what it heard goes to a node like its own, what it says comes back.

A log holds what was said in the order the recorder received it, not that in which the agent did. In lockstep that does
not matter: each message is delivered as soon as the agent's next measurement needs it, in the log's order otherwise.
In real time it does. But there each step report says how old the newest state of every other agent was, and plans of
one sender keep their order: so it is known which of them the agent had, to the last one.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import threadpoolctl

from agent.node import AgentNode
from protocol.scenario.setup import Setup
from protocol.wire.messages import (
    FaultNote,
    LinkChange,
    Measurement,
    Message,
    Plan,
    Presence,
    Roster,
    StepReport,
    agent_name,
)
from transport.log.run_log import RunLog

# In real time, when a plan counts as received that is known to have been there: before any delay began to matter.
_LONG_AGO_NS = -(2**80)

Answer = Plan | StepReport


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One tick of the agent.

    Attributes:
        tick: Which.
        incarnation: Which start of the agent.
        said: What the node says at it now: its plans, the last one with negotiation 0, and its report.
        recorded: What the log has in the place of each; None where it has nothing.
    """

    tick: int
    incarnation: int
    said: tuple[Answer, ...]
    recorded: tuple[Answer | None, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Life:
    """One process of the agent: from when it is first on the roster to when the next process takes its place.

    Attributes:
        incarnation: Under which it begins; one that is frozen and thawed goes on under higher ones.
        version: Of the roster that admits it.
        first: Tick of that roster.
        end: Tick at which the next process is admitted; one past the end of the run for the last.
        end_version: Of the roster that admits the next process, None for the last.
    """

    incarnation: int
    version: int
    first: int
    end: int
    end_version: int | None


@dataclass(slots=True)
class Replay:
    """Feeds one agent of a run.

    Args:
        setup: What the agent is told to be: the run as it was flown, or with a controller of another kind.
        log: What was said in the run.
        agent: Which agent, 1-based.
        before: Called ahead of each measurement, with the node that is about to get it.

    Attributes:
        notes: What could not be fed, for people.
        refused: Messages the node refused: how many, and what was wrong with the first.
    """

    setup: Setup
    log: RunLog
    agent: int
    before: Callable[[AgentNode, Measurement], None] | None = None
    notes: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    def steps(self) -> Iterator[Step]:
        """The agent's ticks, in order.

        A generator: whoever wants to look at the node in between stops asking.
        """
        name = agent_name(self.agent)
        lives = _lives(self.setup, self.log, self.agent)
        if not lives:
            self.notes.append(f"{name} is on no roster that the log holds")
        recorded = {_place(message): message for message in self._of_agent()}
        with threadpoolctl.threadpool_limits(1):  # as every process of a run, for the same bits
            for life in lives:
                node = AgentNode(self.setup, self.agent, life.incarnation)
                feed = self._lockstep if self.setup.scenario.clock.mode == "lockstep" else self._realtime
                for said in _by_tick(feed(node, life)):
                    yield Step(
                        tick=said[0].tick,
                        incarnation=said[0].incarnation,
                        said=said,
                        recorded=tuple(recorded.get(_place(message)) for message in said),
                    )
                self.refused += [
                    f"{entry.count} of {entry.sender} ({entry.reason.replace('_', ' ')}: {entry.example})"
                    for entry in node.rejected
                ]

    def _of_agent(self) -> Iterator[Answer]:
        for entry in self.log.messages:
            if isinstance(entry.message, Plan | StepReport) and entry.message.agent == self.agent:
                yield entry.message

    def _lockstep(self, node: AgentNode, life: Life) -> Iterator[Message]:
        """Feed one process in an order in which it could have heard it all."""
        measured = self._measurements(life)
        last = measured[-1].tick if measured else -1
        before: Measurement | None = None
        answered = True
        members: dict[int, int] = {}
        for message in _causal(self._heard(life), measured, last):
            if isinstance(message, Measurement):
                # While an agent is off the roster nothing is measured for it; the next one names another roster.
                follows = before is None or message.roster != before.roster or message.tick == before.tick + 1
                if not (answered and follows):
                    self._stopped(before.tick if before is not None and not answered else message.tick)
                    return
                self._announce(node, message)
                before, answered = message, False
            said = list(node.receive(message, 0))
            if isinstance(message, Roster):
                now = dict(zip(message.agents, message.incarnations, strict=True))
                # Whatever those who left have said is fed by the tick that needs it: nobody is to wait for more.
                for agent, incarnation in members.items():
                    if now.get(agent) != incarnation:
                        said += node.receive(Presence(agent_name(agent), incarnation, alive=False), 0)
                members = now
            answered = answered or any(isinstance(answer, StepReport) for answer in said)
            yield from said

    def _announce(self, node: AgentNode, measurement: Measurement) -> None:
        if self.before is not None:
            self.before(node, measurement)

    def _stopped(self, tick: int) -> None:
        self.notes.append(
            f"tick {tick} cannot be replayed, nor what follows: the log lacks a measurement of agent{self.agent}, or "
            f"plans of the tick before ({self.log.cut or 'it was not recorded'})"
        )

    def _realtime(self, node: AgentNode, life: Life) -> Iterator[Message]:
        """Feed one process what its reports say it knew."""
        reports = {r.tick: r for r in self.log.of(StepReport) if r.agent == self.agent}
        at_ns = {
            entry.message.tick: entry.received_ns
            for entry in self.log.messages
            if isinstance(entry.message, Measurement) and entry.message.agent == self.agent
        }
        heard = self._heard(life)
        news = [message for message in heard if not isinstance(message, Plan)]
        plans: dict[int, list[Plan]] = {}
        for plan in heard:
            if isinstance(plan, Plan):
                plans.setdefault(plan.agent, []).append(plan)
        for measurement in self._measurements(life):
            while news and _known(news, measurement.roster):
                yield from node.receive(news.pop(0), 0)
            report = reports.get(measurement.tick)
            if report is not None:
                for peer, age in zip(report.peers, report.state_ages, strict=True):
                    waiting = plans.get(peer, [])
                    had = 0 if age < 0 else bisect_left(waiting, measurement.tick - age + 1, key=lambda p: p.tick)
                    for plan in waiting[:had]:
                        yield from node.receive(plan, _LONG_AGO_NS)
                    del waiting[:had]
            self._announce(node, measurement)
            now_ns = at_ns[measurement.tick]
            yield from node.receive(measurement, now_ns)
            if report is not None:
                yield from node.poll(now_ns)

    def _measurements(self, life: Life) -> list[Measurement]:
        found = (m for m in self.log.of(Measurement) if m.agent == self.agent and life.first <= m.tick < life.end)
        return sorted(found, key=lambda m: m.tick)

    def _heard(self, life: Life) -> list[Message]:
        """What the process could hear besides its measurements, in the order of the log."""
        admitted = next(r for r in self.log.of(Roster) if r.version == life.version)
        heard: list[Message] = []
        for entry in self.log.messages:
            match entry.message:
                case Roster(version=version):
                    if version < life.version or (life.end_version is not None and version >= life.end_version):
                        continue
                case LinkChange(sequence=sequence):
                    # Those before it joined are told again ahead of the roster that admits it.
                    if life.end_version is not None and sequence > admitted.sequence and entry.message.tick > life.end:
                        continue
                case Plan(agent=agent, tick=tick, shared=shared):
                    if agent == self.agent or not shared or not life.first <= tick < life.end:
                        continue
                case _:
                    continue
            heard.append(entry.message)
        return heard


def _lives(setup: Setup, log: RunLog, agent: int) -> list[Life]:
    """The processes an agent had, by the rosters that admit them."""
    starts: list[tuple[int, Roster]] = []
    for roster in log.of(Roster):
        incarnation = dict(zip(roster.agents, roster.incarnations, strict=True)).get(agent)
        if incarnation is None or (starts and starts[-1][0] == incarnation):
            continue
        if starts and _went_on(setup, log, agent, (starts[-1][0], incarnation), (starts[-1][1].tick, roster.tick)):
            continue
        starts.append((incarnation, roster))
    lives = []
    for i, (incarnation, roster) in enumerate(starts):
        after = starts[i + 1][1] if i + 1 < len(starts) else None
        lives.append(
            Life(
                incarnation=incarnation,
                version=roster.version,
                first=roster.tick,
                end=setup.ticks if after is None else after.tick,
                end_version=None if after is None else after.version,
            )
        )
    return lives


def _went_on(setup: Setup, log: RunLog, agent: int, incarnations: tuple[int, int], ticks: tuple[int, int]) -> bool:
    """Whether an agent that rejoined is the same process as before, which found itself off the roster."""
    name, (was, now), (since, until) = agent_name(agent), incarnations, ticks
    notes = [note.what for note in log.of(FaultNote) if note.target == name and since <= note.tick <= until]
    if now != was + 1:
        return False
    if notes:
        return notes[-1] == "continued"
    # A flight within one process notes nothing, and has a new node for whoever comes back.
    return not any(fault.target == name and since < fault.tick <= until for fault in setup.faults)


def _causal(heard: Sequence[Message], measured: Sequence[Measurement], last: int) -> list[Message]:
    """Everything in the order of the ticks that need it; within one the order of the log, its measurement last."""
    # News of the coordinator counts for the first measurement that names its roster, or the tick after its own.
    naming = [(m.roster, m.tick) for m in measured]
    order: list[tuple[int, int, int, Message]] = []
    pending: list[int] = []  # changes of links ahead of the roster that follows them
    for i, message in enumerate(heard):
        if isinstance(message, LinkChange):
            pending.append(i)
            continue
        if isinstance(message, Roster):
            named = next((tick for version, tick in naming if version >= message.version), last + 1)
            at = min(named, message.tick + 1)
            order += [(at, 0, j, heard[j]) for j in pending]
            pending.clear()
        else:
            at = message.tick + 1
        order.append((at, 0, i, message))
    order += [(m.tick, 1, 0, m) for m in measured]
    order.sort(key=lambda entry: entry[:3])
    return [message for at, _, _, message in order if at <= last + 1]


def _known(news: Sequence[Message], version: int) -> bool:
    """Whether the first of the coordinator's messages belongs to what a measurement that names a roster follows."""
    first = next((message for message in news if isinstance(message, Roster)), None)
    return first is not None and first.version <= version


def _by_tick(messages: Iterator[Message]) -> Iterator[tuple[Answer, ...]]:
    """What a node says, tick by tick: each ends with its report."""
    said: list[Answer] = []
    for message in messages:
        if isinstance(message, Plan | StepReport):
            said.append(message)
        if isinstance(message, StepReport):
            yield tuple(said)
            said = []


def _place(message: Answer) -> tuple[str, int, int, int]:
    """What tells a message of the agent from its others."""
    negotiation = message.negotiation if isinstance(message, Plan) else 0
    return message.kind, message.incarnation, message.tick, negotiation
