"""Processes of an agent in a recorded run, the messages each could receive, and their order."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from transport.log.run_log import RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import (
    CONTINUED,
    Airtime,
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
_BEFORE = 0
_MEASUREMENT = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentProcess:
    """One process of an agent, 1-based."""

    agent: int
    incarnation: int  # its first one; a process that is stopped and continued gets higher ones
    admitted: Roster  # that admits it
    replaced: Roster | None  # that admits the next process of the agent; None for the last process
    # From that of `admitted` to the one before that of `replaced`, or to the end of the run.
    ticks: range

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
        replaced = self.replaced
        match message:
            case Roster():
                if message.version < self.admitted.version:
                    return False
                return replaced is None or message.version < replaced.version
            case LinkChange() | Target():
                # Earlier changes are sent again ahead of the roster that admits the process.
                return replaced is None or message.tick <= replaced.tick
            case Airtime():
                return message.tick in self.ticks
            case Plan():
                is_others = message.agent != self.agent and message.shared
                return is_others and message.tick in self.ticks
        return False


def processes_of(setup: Setup, log: RunLog, agent: int) -> list[AgentProcess]:
    """Return the processes of an agent, one for each roster that admits a new one."""
    starts = _starts(setup, log, agent)

    processes = []
    for number, (incarnation, roster) in enumerate(starts, start=1):
        replaced = starts[number][1] if number < len(starts) else None
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
    # The process may be stopped or killed in the tick that admits it; its own return is noted
    # before that tick is open.
    notes = [
        note.what
        for note in log.of(FaultNote)
        if note.target == name and since <= note.tick <= until
    ]
    if notes:
        return notes[-1] == CONTINUED

    # An in-memory run records no notes, and has a new node for every agent that rejoins after a
    # fault. The fault at the tick that admits the process is its own return.
    return not any(fault.target == name and since < fault.tick <= until for fault in setup.faults)


class _Need(NamedTuple):
    """Place of a message in the order of need."""

    tick: int  # that needs it
    rank: int  # _BEFORE or _MEASUREMENT
    number: int  # place among the messages of the log
    message: Message


def in_order_of_need(
    received: Sequence[Message], measurements: Sequence[Measurement]
) -> list[Message]:
    """Return all messages sorted by the tick that needs them.

    Within a tick they have the order of the log, with the measurement last.
    """
    last = measurements[-1].tick if measurements else -1
    # Needed after the last measurement: proposals of its tick, without which the step does not end.
    end = last + 1

    needs: list[_Need] = []
    pending: list[int] = []  # places of changes of links and targets: they need the next roster
    for number, message in enumerate(received):
        if isinstance(message, LinkChange | Target):
            pending.append(number)
            continue
        tick = _tick_of_need(message)
        if isinstance(message, Roster):
            tick = min(tick, _first_need(message, measurements, end))
            needs += [_Need(tick, _BEFORE, place, received[place]) for place in pending]
            pending.clear()
        needs.append(_Need(tick, _BEFORE, number, message))

    for measurement in measurements:
        needs.append(_Need(measurement.tick, _MEASUREMENT, 0, measurement))
    needs.sort(key=lambda need: need[:3])  # messages have no order
    return [need.message for need in needs if need.tick <= end]


def _tick_of_need(message: Message) -> int:
    """Return the tick whose measurement comes after a message.

    A plan of tick k is needed at k + 1, and a proposal of k after the measurement of k, as is the
    radio's message about it: all lie between the measurements of k and k + 1. The radio's message
    about the time until k is needed at k.
    """
    if isinstance(message, Airtime) and message.negotiation == 0:
        return message.tick
    return message.tick + 1


def _first_need(roster: Roster, measurements: Sequence[Measurement], otherwise: int) -> int:
    """Return the tick of the first measurement that names a roster or a later one."""
    for measurement in measurements:
        if measurement.roster >= roster.version:
            return measurement.tick
    return otherwise
