"""Processes of an agent in a recorded run, the messages each could receive, and their order."""

from collections.abc import Sequence
from dataclasses import dataclass

from transport.log.run_log import RunLog
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import (
    FaultNote,
    LinkChange,
    Measurement,
    Message,
    Plan,
    Roster,
    Target,
    agent_name,
)

# Order of the messages that a tick needs.
_CHANGES = 0
_MEASUREMENT = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentProcess:
    """One process of an agent, 1-based."""

    agent: int
    incarnation: int  # its first one; a process that is stopped and continued gets higher ones
    admitted: Roster  # that admits it
    replaced: Roster | None  # that admits the next process of the agent; None for the last process
    ticks: (
        range  # from that of `admitted` to the one before that of `replaced`, or to the run's end
    )

    def measurements(self, log: RunLog) -> list[Measurement]:
        """Return the measurements of the process in the order of their ticks."""
        own = [
            measurement
            for measurement in log.of(Measurement)
            if measurement.agent == self.agent and measurement.tick in self.ticks
        ]
        return sorted(own, key=lambda measurement: measurement.tick)

    def received(self, log: RunLog) -> list[Message]:
        """Return the messages it could receive but for its measurements, as the log orders them."""
        return [entry.message for entry in log.messages if self._receives(entry.message)]

    def _receives(self, message: Message) -> bool:
        """Return whether a message, other than a measurement, could reach the process."""
        match message:
            case Roster():
                is_early = self.replaced is None or message.version < self.replaced.version
                return self.admitted.version <= message.version and is_early
            case LinkChange() | Target():
                # Earlier changes are sent again ahead of the roster that admits the process.
                return (
                    self.replaced is None
                    or message.sequence <= self.admitted.sequence
                    or message.tick <= self.replaced.tick
                )
            case Plan():
                is_others = message.agent != self.agent and message.shared
                return is_others and message.tick in self.ticks
        return False


def processes_of(setup: Setup, log: RunLog, agent: int) -> list[AgentProcess]:
    """Return the processes of an agent, one for each roster that admits a new one."""
    starts = _starts(setup, log, agent)
    successors: list[Roster | None] = [roster for _, roster in starts[1:]]
    successors.append(None)

    processes = []
    for (incarnation, roster), replaced in zip(starts, successors, strict=False):
        end = setup.ticks if replaced is None else replaced.tick
        processes.append(
            AgentProcess(
                agent=agent,
                incarnation=incarnation,
                admitted=roster,
                replaced=replaced,
                ticks=range(roster.tick, end),
            )
        )
    return processes


def _starts(setup: Setup, log: RunLog, agent: int) -> list[tuple[int, Roster]]:
    """Return the first incarnation of each process of an agent, and the roster that admits it."""
    starts: list[tuple[int, Roster]] = []
    for roster in log.of(Roster):
        incarnations = dict(zip(roster.agents, roster.incarnations, strict=True))
        incarnation = incarnations.get(agent)
        if incarnation is None:
            continue
        if starts and _is_same_process(setup, log, agent, starts[-1], (incarnation, roster)):
            continue
        starts.append((incarnation, roster))
    return starts


def _is_same_process(
    setup: Setup,
    log: RunLog,
    agent: int,
    start: tuple[int, Roster],
    later: tuple[int, Roster],
) -> bool:
    """Return whether an agent on a later roster is the process that has started before."""
    first, admitted = start
    incarnation, roster = later
    if incarnation == first:
        return True
    if incarnation != first + 1:
        return False
    return _continued(setup, log, agent_name(agent), admitted.tick, roster.tick)


def _continued(setup: Setup, log: RunLog, name: str, since: int, until: int) -> bool:
    """Return whether an agent that rejoined between two ticks is the same process.

    Such a process noticed that it was off the roster.
    """
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


def in_order_of_need(
    received: Sequence[Message], measurements: Sequence[Measurement]
) -> list[Message]:
    """Return all messages sorted by the tick that needs them.

    Within a tick they have the order of the log, with the measurement last.
    """
    last = measurements[-1].tick if measurements else -1
    order: list[tuple[int, int, int, Message]] = []
    pending: list[int] = []  # changes of links and targets, which belong to the next roster
    for number, message in enumerate(received):
        if isinstance(message, LinkChange | Target):
            pending.append(number)
            continue
        tick = message.tick + 1
        if isinstance(message, Roster):
            tick = min(tick, _first_need(message, measurements, last + 1))
            order += [(tick, _CHANGES, change, received[change]) for change in pending]
            pending.clear()
        order.append((tick, _CHANGES, number, message))

    order += [(measurement.tick, _MEASUREMENT, 0, measurement) for measurement in measurements]
    order.sort(key=lambda entry: entry[:3])
    return [message for tick, _, _, message in order if tick <= last + 1]


def _first_need(roster: Roster, measurements: Sequence[Measurement], otherwise: int) -> int:
    """Return the tick of the first measurement that names a roster or a later one."""
    for measurement in measurements:
        if measurement.roster >= roster.version:
            return measurement.tick
    return otherwise
