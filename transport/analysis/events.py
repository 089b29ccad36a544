"""Events of a run: faults of processes and UAVs, changes of the roster, and why the run ended if it failed."""

from collections.abc import Iterable
from typing import Any

from protocol.scenario.faults import degradations, uav_name
from protocol.scenario.setup import Setup
from protocol.wire.message import Message
from protocol.wire.messages import ActualInputs, Control, FaultNote, Roster, Tick
from protocol.wire.names import agent_name
from transport.log.run_log import RunLog

_ORIGIN = {"script": " by script", "person": " by hand", "unknown": ""}


def events(setup: Setup, log: RunLog, control: Control | None) -> list[dict[str, Any]]:
    """Return the events in the order of their ticks, as JSON data with the fields of `faults` in summary.schema.json.

    The log is in the order of arrival, and on a busy host the messages of one process may arrive ticks after those of
    another.
    """
    found: list[dict[str, Any]] = []
    began_ns = min(log.received_ns(Tick).values(), default=None)

    def add(message: Message, received_ns: int | None, kind: str, what: str, processes: Iterable[str]) -> None:
        found.append(
            {
                "tick": message.tick,
                "time_s": message.tick * setup.settings.sampling_period_s,
                "wall_s": None if began_ns is None or received_ns is None else (received_ns - began_ns) / 1e9,
                "kind": kind,
                "processes": list(processes),
                "what": what,
            }
        )

    degraded = degradations(setup.faults)
    before: Roster | None = None
    off: set[tuple[str, int]] = set()  # UAVs with their motors off, and released ones
    for message, received_ns in ((entry.message, entry.received_ns) for entry in log.messages):
        if isinstance(message, FaultNote):
            what = f"{message.target} {message.what}{_ORIGIN[message.origin]}"
            add(message, received_ns, "fault", what, [message.target])
        elif isinstance(message, ActualInputs):
            for uav, efficiency in ((uav, share) for tick, uav, share in degraded if tick == message.tick):
                what = f"motors of {uav_name(uav)} degraded to {efficiency:g} of their inputs by script"
                add(message, received_ns, "fault", what, [uav_name(uav)])
        elif isinstance(message, Roster):
            now_off = {("off", uav) for uav in message.off} | {("released", uav) for uav in message.released}
            if now_off != off:
                uavs = sorted({uav for _, uav in now_off - off})
                add(message, received_ns, "fault", f"{message.reason} by script", [f"uav{uav}" for uav in uavs])
            elif before is not None:
                old, new = set(before.agents), set(message.agents)
                left, joined = ([agent_name(agent) for agent in sorted(agents)] for agents in (old - new, new - old))
                kind = "detected" if left else "rejoined" if joined else "notice"
                add(message, received_ns, kind, message.reason, left or joined)
            before, off = message, now_off
    found.sort(key=lambda event: int(event["tick"]))
    if control is not None and control.reason:
        add(control, log.received_ns(Control).get(control.tick), "end", control.reason, [])
    return found
