"""Replay of one agent: a node like the recorded one gets the recorded messages.

Its answers stand beside theirs. A log has the order of the recorder, which in lockstep does not
matter: each message is delivered when a measurement needs it. In real time each report states the
age of the newest state of every other agent, and plans of one sender keep their order: together
they tell which plans the agent had.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass

import threadpoolctl

from transport.agent.node import AgentNode
from transport.agent.user_class.user_controllers import checked_controller
from transport.analysis.replay.replayed_processes import (
    AgentProcess,
    in_order_of_need,
    processes_of,
)
from transport.log.run_log import RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import (
    Measurement,
    Message,
    Plan,
    Roster,
    StepReport,
    agent_name,
)

# Arrival time of plans in real time, ns: so early that no delay applies to a plan that has been
# there for sure.
_LONG_AGO_NS = -(2**80)

Answer = Plan | StepReport


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayedStep:
    """One tick of the agent."""

    tick: int
    # Plans of the replayed node, the last one with negotiation 0, then its report.
    answers: tuple[Answer, ...]
    # The recorded message for each of them; None if the log has none.
    recorded: tuple[Answer | None, ...]


def _leave(_node: AgentNode, _measurement: Measurement) -> None:
    """Leave a node as it is."""


class Replay:
    """Replay of one agent, 1-based, of a run, or of the same run with another controller.

    `before_measurement` is called with the node and each measurement before the node receives it.
    `notes` has sentences about the parts that could not be replayed.
    """

    def __init__(
        self,
        setup: Setup,
        log: RunLog,
        agent: int,
        before_measurement: Callable[[AgentNode, Measurement], None] = _leave,
    ) -> None:
        self.setup = setup
        self.log = log
        self.agent = agent
        self.before_measurement = before_measurement
        self.notes: list[str] = []

    def steps(self) -> Iterator[ReplayedStep]:
        """Yield the ticks of the agent, in order."""
        processes = processes_of(self.setup, self.log, self.agent)
        if not processes:
            self.notes.append(f"{agent_name(self.agent)} is on no roster in the log")
        self._note_controller()

        recorded = self._recorded()
        feed = self._lockstep if self.setup.scenario.clock.mode == "lockstep" else self._realtime
        with threadpoolctl.threadpool_limits(1):  # as in every process of a run, for the same bits
            for process in processes:
                node = AgentNode(self.setup.run, self.agent, process.incarnation)
                yield from _steps(feed(node, process), recorded)

    def _note_controller(self) -> None:
        """Note that the run was recorded with another version of the agents' own controller."""
        recorded_with = self.log.header.get("controller", "")
        names = dict.fromkeys(self.setup.scenario.controllers)
        if not any(f"{name} " in recorded_with for name in names):
            return

        present = checked_controller(self.setup.run)
        if present != recorded_with:
            self.notes.append(
                f"the run was recorded with controller {recorded_with}, this is {present}"
            )

    def _recorded(self) -> dict[tuple[str, int, int, int], Answer]:
        """Return the recorded answers of the agent."""
        sent: list[Answer] = [*self.log.of(Plan), *self.log.of(StepReport)]
        return {_identity(answer): answer for answer in sent if answer.agent == self.agent}

    def _give(self, node: AgentNode, message: Message, now_ns: int) -> list[Message]:
        """Hand a message to a node as its gate would; return the answers."""
        with suppress(MessageError):
            node.check_moment(message)
            return list(node.receive(message, now_ns))
        return []

    def _lockstep(self, node: AgentNode, process: AgentProcess) -> Iterator[Message]:
        """Feed one process in a possible order of arrival, and yield its messages."""
        measurements = process.measurements(self.log)
        before: Measurement | None = None
        answered = True
        for message in in_order_of_need(process.received(self.log), measurements):
            if isinstance(message, Measurement):
                if not (answered and _follows(message, before)):
                    lacking = message if answered or before is None else before
                    self._note_gap(lacking.tick)
                    return
                self.before_measurement(node, message)
                before = message
                answered = False

            answers = self._give(node, message, 0)
            answered = answered or any(isinstance(answer, StepReport) for answer in answers)
            yield from answers

    def _note_gap(self, tick: int) -> None:
        """Note that the log lacks messages from a tick on."""
        missing = f"a measurement of agent{self.agent}, or plans of the previous tick"
        self.notes.append(f"ticks from {tick} on cannot be replayed: the log lacks {missing}")

    def _realtime(self, node: AgentNode, process: AgentProcess) -> Iterator[Message]:
        """Feed one process the messages that its reports say it had, and yield its messages."""
        reports = {
            report.tick: report for report in self.log.of(StepReport) if report.agent == self.agent
        }
        arrived_ns = {id(entry.message): entry.received_ns for entry in self.log.messages}
        received = process.received(self.log)
        plans = [message for message in received if isinstance(message, Plan)]
        # Changes of roster, links and target.
        changes = [message for message in received if not isinstance(message, Plan)]

        for measurement in process.measurements(self.log):
            due = _due_changes(changes, measurement)
            for change in changes[:due]:
                yield from self._give(node, change, 0)
            changes = changes[due:]

            report = reports.get(measurement.tick)
            newest = {} if report is None else _newest_plans(report, measurement.tick)
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


def _steps(
    messages: Iterator[Message], recorded: dict[tuple[str, int, int, int], Answer]
) -> Iterator[ReplayedStep]:
    """Yield the ticks of one process from its messages; a report ends a tick."""
    answers: list[Answer] = []
    for message in messages:
        if isinstance(message, Plan | StepReport):
            answers.append(message)
        if isinstance(message, StepReport):
            yield ReplayedStep(
                tick=answers[0].tick,
                answers=tuple(answers),
                recorded=tuple(recorded.get(_identity(answer)) for answer in answers),
            )
            answers = []


def _follows(measurement: Measurement, before: Measurement | None) -> bool:
    """Return whether no measurement is missing between two of an agent.

    An agent off the roster gets none; the first one after that names another roster.
    """
    if before is None or measurement.roster != before.roster:
        return True
    return measurement.tick == before.tick + 1


def _due_changes(changes: list[Message], measurement: Measurement) -> int:
    """Return the number of changes up to the last roster that a measurement may name.

    Changes up to the next roster count together with it.
    """
    due = 0
    for number, change in enumerate(changes, start=1):
        if isinstance(change, Roster):
            if change.version > measurement.roster:
                break
            due = number
    return due


def _newest_plans(report: StepReport, tick: int) -> dict[int, int]:
    """Return the tick of the newest plan that a step had, by sender, without those never heard."""
    ages = zip(report.peers, report.state_ages, strict=True)
    return {peer: tick - age for peer, age in ages if age >= 0}


def _identity(message: Answer) -> tuple[str, int, int, int]:
    """Return the fields that distinguish a message from the agent's others."""
    negotiation = message.negotiation if isinstance(message, Plan) else 0
    return message.kind, message.incarnation, message.tick, negotiation
