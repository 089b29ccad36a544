"""Replay of one agent: a node like the recorded one gets the recorded messages.

Its answers are compared with theirs.

A log has the order of the recorder, which in lockstep does not matter: each message is delivered
when a measurement needs it. In real time each report states the age of the newest state of every
other agent, and plans of one sender keep
their order: together they tell which plans the agent had.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import threadpoolctl

from transport.agent.node import AgentNode
from transport.agent.own import checked_controller
from transport.log.run_log import RunLog
from transport.log.tables import INPUT_NAMES
from transport.model.state import INPUTS
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.errors import MessageError
from transport.protocol.wire.messages import (
    FaultNote,
    LinkChange,
    Measurement,
    Message,
    Plan,
    Roster,
    StepReport,
    Target,
    agent_name,
)

# Arrival time of plans in real time, ns: so early that no delay applies to a plan that is known to
# have been there.
_LONG_AGO_NS = -(2**80)

# Fields that identify a message or depend on the wall clock.
_NOT_COMPARED = ("sender", "incarnation", "sequence", "tick", "agent", "negotiation", "times_ms")

Answer = Plan | StepReport


class Step(NamedTuple):
    """One tick of the agent."""

    tick: int
    answers: tuple[
        Answer, ...
    ]  # plans of the replayed node, the last one with negotiation 0, then its report
    recorded: tuple[
        Answer | None, ...
    ]  # the recorded message for each of them; None if the log has none


class _Process(NamedTuple):
    """One process of the agent."""

    incarnation: int  # its first one; a process that is stopped and continued gets higher ones
    admitted: Roster  # that admits it
    replaced: Roster | None  # that admits the next process of the agent; None for the last process
    ticks: range  # from the tick of `admitted` to the last one before that of `replaced`, or to the end of the run


class Replay:
    """Replay of one agent, 1-based, of a run, or of the same run with another controller.

    `before_measurement` is called with the node and each measurement before the node receives it.
    `notes` has sentences about what could not be replayed.
    """

    def __init__(
        self,
        setup: Setup,
        log: RunLog,
        agent: int,
        before_measurement: Callable[[AgentNode, Measurement], None] = lambda _node, _measurement: (
            None
        ),
    ) -> None:
        self.setup, self.log, self.agent, self.before_measurement = (
            setup,
            log,
            agent,
            before_measurement,
        )
        self.notes: list[str] = []

    def steps(self) -> Iterator[Step]:
        """Yield the ticks of the agent, in order."""
        processes = _processes(self.setup, self.log, self.agent)
        if not processes:
            self.notes.append(f"{agent_name(self.agent)} is on no roster in the log")
        sent: list[Answer] = [*self.log.of(Plan), *self.log.of(StepReport)]
        recorded = {_identity(one): one for one in sent if one.agent == self.agent}
        name, was = self.setup.scenario.agents.controller, self.log.header.get("controller", "")
        if was.startswith(f"{name} ") and (now := checked_controller(self.setup)) != was:
            self.notes.append(f"the run was recorded with controller {was}, this is {now}")
        feed = self._lockstep if self.setup.scenario.clock.mode == "lockstep" else self._realtime
        with threadpoolctl.threadpool_limits(1):  # as in every process of a run, for the same bits
            for process in processes:
                answers: list[Answer] = []
                for message in feed(
                    AgentNode(self.setup, self.agent, process.incarnation), process
                ):
                    if isinstance(message, Plan | StepReport):
                        answers.append(message)
                    if isinstance(message, StepReport):  # ends a tick
                        there = tuple(recorded.get(_identity(answer)) for answer in answers)
                        yield Step(answers[0].tick, tuple(answers), there)
                        answers = []

    def _give(self, node: AgentNode, message: Message, now_ns: int) -> list[Message]:
        """Hand a message to a node as its gate would; return the answers."""
        with suppress(MessageError):
            node.check_moment(message)
            return list(node.receive(message, now_ns))
        return []

    def _lockstep(self, node: AgentNode, process: _Process) -> Iterator[Message]:
        """Feed one process in a possible order of arrival, and yield its messages."""
        measurements = self._measurements(process)
        before: Measurement | None = None
        answered = True
        for message in _in_order_of_need(self._received(process), measurements):
            if isinstance(message, Measurement):
                # An agent off the roster gets no measurements; the first one after that names
                # another roster.
                follows = (
                    before is None
                    or message.roster != before.roster
                    or message.tick == before.tick + 1
                )
                if not (answered and follows):
                    tick = message.tick if answered or before is None else before.tick
                    why = f"the log lacks a measurement of agent{self.agent}, or plans of the previous tick"
                    self.notes.append(f"ticks from {tick} on cannot be replayed: {why}")
                    return
                self.before_measurement(node, message)
                before, answered = message, False
            answers = self._give(node, message, 0)
            answered = answered or any(isinstance(answer, StepReport) for answer in answers)
            yield from answers

    def _realtime(self, node: AgentNode, process: _Process) -> Iterator[Message]:
        """Feed one process the messages that its reports say it had, and yield its messages."""
        reports = {
            report.tick: report for report in self.log.of(StepReport) if report.agent == self.agent
        }
        arrived_ns = {id(entry.message): entry.received_ns for entry in self.log.messages}
        received = self._received(process)
        plans = [message for message in received if isinstance(message, Plan)]
        changes = [
            message for message in received if not isinstance(message, Plan)
        ]  # of roster, links and target
        for measurement in self._measurements(process):
            # Changes up to the next roster count together with it.
            while (roster := next((c for c in changes if isinstance(c, Roster)), None)) is not None:
                if roster.version > measurement.roster:
                    break
                yield from self._give(node, changes.pop(0), 0)
            report = reports.get(measurement.tick)
            ages = {} if report is None else dict(zip(report.peers, report.state_ages, strict=True))
            newest = {peer: measurement.tick - age for peer, age in ages.items() if age >= 0}
            waiting: list[Plan] = []
            for plan in plans:
                if plan.tick > newest.get(plan.agent, -1):
                    waiting.append(plan)
                else:
                    yield from self._give(node, plan, _LONG_AGO_NS)
            plans = waiting
            self.before_measurement(node, measurement)
            now_ns = arrived_ns[id(measurement)]
            yield from self._give(node, measurement, now_ns)
            if report is not None:
                yield from node.poll(now_ns)

    def _measurements(self, process: _Process) -> list[Measurement]:
        found = (
            m for m in self.log.of(Measurement) if m.agent == self.agent and m.tick in process.ticks
        )
        return sorted(found, key=lambda m: m.tick)

    def _received(self, process: _Process) -> list[Message]:
        """Return the messages a process could receive besides its measurements, in the order of the log."""
        admitted, replaced = process.admitted, process.replaced

        def concerns(message: Message) -> bool:
            match message:
                case Roster(version=version):
                    return admitted.version <= version and (
                        replaced is None or version < replaced.version
                    )
                case (
                    LinkChange(sequence=sequence, tick=tick) | Target(sequence=sequence, tick=tick)
                ):
                    # Earlier changes are sent again ahead of the roster that admits the process.
                    return (
                        replaced is None or sequence <= admitted.sequence or tick <= replaced.tick
                    )
                case Plan(agent=agent, tick=tick, shared=shared):
                    return agent != self.agent and shared and tick in process.ticks
            return False

        return [entry.message for entry in self.log.messages if concerns(entry.message)]


def _processes(setup: Setup, log: RunLog, agent: int) -> list[_Process]:
    """Return the processes of an agent, one for each roster that admits a new one."""
    starts: list[tuple[int, Roster]] = []
    for roster in log.of(Roster):
        incarnation = dict(zip(roster.agents, roster.incarnations, strict=True)).get(agent)
        if incarnation is None:
            continue
        if starts:
            last, since = starts[-1]
            if incarnation == last:
                continue
            if incarnation == last + 1 and _continued(
                setup, log, agent_name(agent), since.tick, roster.tick
            ):
                continue
        starts.append((incarnation, roster))
    if not starts:
        return []
    found = []
    for (incarnation, roster), replaced in zip(
        starts, [*(roster for _, roster in starts[1:]), None], strict=True
    ):
        ticks = range(roster.tick, setup.ticks if replaced is None else replaced.tick)
        found.append(_Process(incarnation, roster, replaced, ticks))
    return found


def _continued(setup: Setup, log: RunLog, name: str, since: int, until: int) -> bool:
    """Return whether an agent that rejoined is the same process, which noticed that it was off the roster."""
    notes = [
        note.what
        for note in log.of(FaultNote)
        if note.target == name and since <= note.tick <= until
    ]
    if notes:
        return notes[-1] == "continued"
    # An in-memory run records no notes, and has a new node for every agent that rejoins after a
    # fault.
    return not any(fault.target == name and since < fault.tick <= until for fault in setup.faults)


def _in_order_of_need(
    received: Sequence[Message], measurements: Sequence[Measurement]
) -> list[Message]:
    """Return all messages sorted by the tick that needs them.

    Within a tick the order of the log, measurement last.
    """
    last = measurements[-1].tick if measurements else -1
    order: list[tuple[int, int, int, Message]] = []
    pending: list[int] = []  # changes of links and targets, which belong to the next roster
    for i, message in enumerate(received):
        if isinstance(message, LinkChange | Target):
            pending.append(i)
            continue
        tick = message.tick + 1
        if isinstance(message, Roster):
            # Needed by the first measurement that names it or a later one, at the latest by the
            # tick after its own.
            tick = min(
                tick, next((m.tick for m in measurements if m.roster >= message.version), last + 1)
            )
            order += [(tick, 0, j, received[j]) for j in pending]
            pending.clear()
        order.append((tick, 0, i, message))
    order += [(m.tick, 1, 0, m) for m in measurements]
    order.sort(key=lambda entry: entry[:3])
    return [message for tick, _, _, message in order if tick <= last + 1]


def _identity(message: Answer) -> tuple[str, int, int, int]:
    """Return the fields that distinguish a message from the agent's others."""
    negotiation = message.negotiation if isinstance(message, Plan) else 0
    return message.kind, message.incarnation, message.tick, negotiation


@dataclass(frozen=True, slots=True)
class Difference:
    """A field in which a message differs from the recorded one, at the entry that differs most."""

    tick: int
    kind: str  # of the message, plan or report
    negotiation: int  # iterations of negotiation that follow the plan; 0 for a report
    name: str  # of the field
    where: str  # description of the entry; empty for a scalar field
    got: str  # replayed value
    expected: str  # recorded value
    size: float | None  # absolute difference, SI; None if the field is no number

    @property
    def field(self) -> str:
        """The field with its kind of message, e.g. plan.inputs."""
        return f"{self.kind}.{self.name}"


@dataclass(slots=True)
class Comparison:
    """Comparison of a replay with its run."""

    ticks: list[int] = field(default_factory=list)  # compared, in order
    plans: int = 0  # number of plans compared
    identical: int = 0  # number of plans that are equal bit for bit
    unrecorded: list[int] = field(
        default_factory=list
    )  # ticks with an answer of the node but not in the log
    by_field: dict[str, list[Difference]] = field(
        default_factory=dict
    )  # in the order they first differ
    # For each tick compared: tick, largest difference of thrust (N) and of moments or rates (SI) of
    # the plan's first step, then of all its steps.
    rows: list[tuple[int, float, float, float, float]] = field(default_factory=list)
    commands: tuple[str, ...] = INPUT_NAMES  # names of the inputs in plans

    @property
    def first(self) -> Difference | None:
        """The first difference in a plan; None if all plans are equal."""
        plans = [found[0] for found in self.by_field.values() if found[0].kind == Plan.kind]
        return min(plans, key=lambda d: (d.tick, -d.negotiation), default=None)

    def first_beyond(self, size: float) -> int | None:
        """Return the first tick at which an input of the plan differs by more than `size`, N or N m; None for none."""
        return next((tick for tick, *apart in self.rows if max(apart) > size), None)

    def add(self, step: Step, *, ignored: Iterable[str] = ()) -> None:
        """Compare the replayed and recorded messages of one tick, except for ignored fields, e.g.

        Report.lost.
        """
        there = [recorded for recorded in step.recorded if recorded is not None]
        if len(there) < len(step.answers):
            self.unrecorded.append(step.tick)
            return
        self.ticks.append(step.tick)
        for answer, recorded in zip(step.answers, there, strict=True):
            found = [
                d for d in differences(answer, recorded, self.commands) if d.field not in ignored
            ]
            if isinstance(answer, Plan):
                self.plans += 1
                self.identical += not found
            for difference in found:
                self.by_field.setdefault(difference.field, []).append(difference)
            if isinstance(answer, Plan) and isinstance(recorded, Plan) and answer.negotiation == 0:
                self.rows.append((step.tick, *_inputs_apart(answer, recorded)))


def differences(
    answer: Answer, recorded: Answer, commands: tuple[str, ...] = INPUT_NAMES
) -> Iterator[Difference]:
    """Yield the fields in which two messages of one kind differ by at least a bit; 0 and -0 do."""
    negotiation = answer.negotiation if isinstance(answer, Plan) else 0
    for name in (name for name in answer.__struct_fields__ if name not in _NOT_COMPARED):
        got, expected = np.asarray(getattr(answer, name)), np.asarray(getattr(recorded, name))
        if got.shape == expected.shape and got.tobytes() == expected.tobytes():
            continue
        where, size = "", None
        if got.shape == expected.shape and got.dtype.kind in "if":
            apart = np.abs(got - expected)
            at = np.unravel_index(int(apart.argmax()), got.shape)
            where, size = _entry(answer, name, [int(i) for i in at], commands), float(apart[at])
            got, expected = got[at], expected[at]
        elif got.ndim:
            got, expected = (
                np.asarray(f"{len(got)} entries"),
                np.asarray(f"{len(expected)} entries"),
            )
        yield Difference(
            answer.tick, answer.kind, negotiation, name, where, str(got), str(expected), size
        )


def _entry(message: Answer, name: str, at: list[int], commands: tuple[str, ...]) -> str:
    """Return a description of an array entry; empty for a scalar."""
    if isinstance(message, Plan) and name in ("inputs", "corrections"):
        return f"{at}, UAV{message.uavs[at[1] // INPUTS]} {commands[at[1] % INPUTS]}, step {at[0]} of the horizon"
    return str(at) if at else ""


def _inputs_apart(plan: Plan, recorded: Plan) -> tuple[float, float, float, float]:
    """Return the largest difference of thrust and of the other inputs.

    At the first step, then over the horizon.
    """
    steps = min(len(plan.inputs), len(recorded.inputs))
    apart = np.abs(plan.inputs[:steps] - recorded.inputs[:steps]).reshape(steps, -1, INPUTS)
    thrust, moments = apart[:, :, 0].max(axis=1), apart[:, :, 1:].max(axis=(1, 2))
    return float(thrust[0]), float(moments[0]), float(thrust.max()), float(moments.max())
