"""Events of a run in its summary: faults, detections, rejoins, notices, and its end."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from transport.log.run_log import Recorded, RunLog
from transport.protocol.scenario.faults.faults_by_tick import Fault
from transport.protocol.scenario.links.link_changes import scripted_changes
from transport.protocol.scenario.sections.lockstep_and_realtime_section import first_tick
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire import messages
from transport.protocol.wire.names import agent_name

# Decimal places of times, s: a tick times the sampling period has rounding errors beyond.
TIME_DIGITS = 9
_NS_PER_S = 1e9
_ORIGIN = {"script": " by script", "person": " by hand", "unknown": ""}

Kind = Literal["fault", "detected", "rejoined", "notice", "end"]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Event:
    """One event at a tick, with the processes or UAVs that it concerns."""

    tick: int
    received_ns: int | None  # when the recorder received its message; None if it did not
    kind: Kind
    text: str
    processes: list[str]


def events(setup: Setup, log: RunLog, control: messages.Control | None) -> list[dict[str, Any]]:
    """Return the events in the order of their ticks, as the field `faults` of the schema."""
    period_s = setup.settings.sampling_period_s
    began_ns = min(log.received_ns(messages.Tick).values(), default=None)
    before_end = [*_scripted_links(setup, log), *_before_end(setup, log)]
    in_order = sorted(before_end, key=lambda event: event.tick)
    if control is not None and control.reason:
        in_order.append(_end(log, control))

    return [
        {
            "tick": event.tick,
            "time_s": round(event.tick * period_s, TIME_DIGITS),
            "wall_s": _elapsed_s(began_ns, event.received_ns),
            "kind": event.kind,
            "processes": event.processes,
            "what": event.text,
        }
        for event in in_order
    ]


def _elapsed_s(began_ns: int | None, received_ns: int | None) -> float | None:
    """Return the wall time between two moments; None if either is not recorded."""
    if began_ns is None or received_ns is None:
        return None
    return (received_ns - began_ns) / _NS_PER_S


def _end(log: RunLog, control: messages.Control) -> _Event:
    """Return the end of the run as an event."""
    return _Event(
        tick=control.tick,
        received_ns=log.received_ns(messages.Control).get(control.tick),
        kind="end",
        text=control.reason,
        processes=[],
    )


def _scripted_links(setup: Setup, log: RunLog) -> Iterator[_Event]:
    """Yield the changes of links by the scenario that the run has reached."""
    last = max((entry.message.tick for entry in log.messages), default=-1)
    for time_s, text in scripted_changes(setup.scenario.links):
        tick = first_tick(time_s, setup.settings.sampling_period_s)
        if tick > last:
            continue
        yield _Event(
            tick=tick,
            received_ns=None,
            kind="notice",
            text=f"{text} by script",
            processes=[],
        )


def _before_end(setup: Setup, log: RunLog) -> Iterator[_Event]:
    """Yield the events before the end, in the order of the log."""
    notices = _Notices(log)
    rosters = _Rosters()
    for entry in log.messages:
        match entry.message:
            case messages.FaultNote():
                yield _fault(entry, entry.message)
            case messages.PlantState():
                yield from _by_plant(setup, entry)
            case messages.Note():
                yield from notices.of(entry, entry.message)
            case messages.Roster():
                yield from rosters.of(entry, entry.message)


def _fault(entry: Recorded, note: messages.FaultNote) -> _Event:
    """Return a fault of a process."""
    return _Event(
        tick=note.tick,
        received_ns=entry.received_ns,
        kind="fault",
        text=f"{note.target} {note.what}{_ORIGIN[note.origin]}",
        processes=[note.target],
    )


def _by_plant(setup: Setup, entry: Recorded) -> Iterator[_Event]:
    """Yield the faults that the plant applies at the tick of its state, and no roster tells of."""
    tick = entry.message.tick
    for fault in setup.faults:
        text = _begin_in_words(fault) if fault.tick == tick else ""
        if not text and fault.do == "sensors_off" and fault.until == tick:
            text = f"{fault.target} has {', '.join(fault.sensors)} again"
        if text:
            yield _Event(
                tick=tick,
                received_ns=entry.received_ns,
                kind="fault",
                text=f"{text} by script",
                processes=[fault.target],
            )


def _begin_in_words(fault: Fault) -> str:
    """Return the begin of a fault that the plant applies; empty for one that a roster tells of."""
    match fault.do:
        case "degrade":
            return f"motors of {fault.target} degraded to {fault.efficiency:g} of their inputs"
        case "sensors_off":
            return f"{fault.target} without {', '.join(fault.sensors)}"
        case "load":
            gradually = "" if fault.until is None else " gradually"
            return f"payload changes{gradually}: {fault.load.in_words()}"
    return ""


# An exception of a class of the user, and the line that raised it.
_RAISED = re.compile(r"(controller \S+: \w+ raised \w+)\b.*( \([^()]+:\d+\))")
_NUMBER = re.compile(r"\d[\w.+-]*")


def _kind_of(problem: str) -> str:
    """Return what problems of a kind share: exception and line, or the text without its numbers.

    The text of a class may differ at each step. Those of the project are kinds of their own.
    """
    if not problem.startswith("controller "):
        return problem
    raised = _RAISED.fullmatch(problem)
    return "".join(raised.groups()) if raised else _NUMBER.sub("0", problem)


class _Notices:
    """Problems that controllers report: each kind is one event of all agents that have it.

    The event is at the first tick of the problem, with its text there.
    """

    def __init__(self, log: RunLog) -> None:
        self._reported: set[str] = set()
        self._agents: dict[str, set[int]] = {}  # by kind
        self._texts: dict[str, set[str]] = {}  # by kind
        for note in log.of(messages.Note):
            kind = _kind_of(note.problem)
            self._agents.setdefault(kind, set()).add(note.agent)
            self._texts.setdefault(kind, set()).add(note.problem)

    def of(self, entry: Recorded, note: messages.Note) -> Iterator[_Event]:
        """Yield the event of a note if it is the first one with its problem."""
        kind = _kind_of(note.problem)
        if not kind or kind in self._reported:
            return

        self._reported.add(kind)
        agents = [agent_name(agent) for agent in sorted(self._agents[kind])]
        others = len(self._texts[kind]) - 1
        more = f" (and {others} like it)" if others else ""
        yield _Event(
            tick=note.tick,
            received_ns=entry.received_ns,
            kind="notice",
            text=f"{', '.join(agents)}: {note.problem}{more}",
            processes=agents,
        )


class _Rosters:
    """Changes from each roster to the next."""

    def __init__(self) -> None:
        self._before: messages.Roster | None = None

    def of(self, entry: Recorded, roster: messages.Roster) -> Iterator[_Event]:
        """Yield the event of a roster, none for the first one unless it has lost UAVs."""
        before = self._before
        self._before = roster
        lost = _lost_uavs(roster)
        if before is not None:
            lost -= _lost_uavs(before)
            # A UAV whose motors were off already is released by an event of its own.
            lost |= {*roster.released} - {*before.released}

        if lost:
            yield _Event(
                tick=roster.tick,
                received_ns=entry.received_ns,
                kind="fault",
                text=f"{roster.reason} by script",
                processes=[f"uav{uav}" for uav in sorted(lost)],
            )
        elif before is not None:
            yield _membership(entry, roster, before)


def _lost_uavs(roster: messages.Roster) -> set[int]:
    """Return the UAVs whose motors are off, or that are released, 1-based."""
    return {*roster.off, *roster.released}


def _membership(entry: Recorded, roster: messages.Roster, before: messages.Roster) -> _Event:
    """Return the agents that departed or joined with a roster as an event."""
    departed = {*before.agents} - {*roster.agents}
    joined = {*roster.agents} - {*before.agents}
    kind: Kind = "notice"
    if departed:
        kind = "detected"
    elif joined:
        kind = "rejoined"

    return _Event(
        tick=roster.tick,
        received_ns=entry.received_ns,
        kind=kind,
        text=roster.reason,
        processes=[agent_name(agent) for agent in sorted(departed or joined)],
    )
