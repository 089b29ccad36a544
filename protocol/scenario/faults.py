"""Scripted faults of processes and of UAVs.

A process ends or stops itself, and its parent restarts or continues it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from transport.protocol.scenario.budget import first_tick
from transport.protocol.scenario.schema import Scenario
from transport.protocol.wire.messages import Measurement, Message, Tick

OF_UAVS = ("motor_off", "release", "degrade", "sensors_off")  # applied by the plant
_FOR_GOOD = ("motor_off", "release")


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault or return of a process when a tick opens for it, or a fault of a UAV from then on."""

    tick: int
    do: Literal[
        "kill", "stop", "continue", "start", "motor_off", "release", "degrade", "sensors_off"
    ]
    target: str  # process name; for faults of UAVs the name of a UAV, such as "uav3"
    efficiency: float = 1.0  # of the motors, for "degrade"
    sensors: tuple[str, ...] = ()  # that fail, for "sensors_off"
    until: int | None = None  # tick at which these measure again; None: never

    @property
    def uav(self) -> int:
        """Return the UAV that is the target, 0-based."""
        return int(self.target.removeprefix("uav")) - 1


def failures(faults: Sequence[Fault]) -> list[Fault]:
    """Return the failures of UAVs for good, in the order of time."""
    return [fault for fault in faults if fault.do in _FOR_GOOD]


def scripted(scenario: Scenario) -> tuple[Fault, ...]:
    """Return the faults of a scenario in the order of time.

    A restart is a kill, unless the process is already down, and a start at least one tick later.
    """
    period_s = scenario.controller.sampling_period_s
    faults: list[Fault] = []
    down_since: dict[str, int] = {}  # tick from which on a process does not run

    for event in sorted(scenario.faults.event, key=lambda event: event.at_s):
        target = event.target
        tick = first_tick(event.at_s, period_s)

        if event.do == "restart" or event.do == "continue":
            if target not in down_since:
                faults.append(Fault(tick, "kill", target))
            earliest = down_since.pop(target, tick) + 1
            do: Literal["start", "continue"] = "start" if event.do == "restart" else "continue"
            faults.append(Fault(max(tick, earliest), do, target))
            continue

        lasting_s = event.duration_s
        fault = Fault(
            tick,
            event.do,
            target,
            efficiency=event.efficiency or 1.0,
            sensors=tuple(event.sensors or ()),
            until=None if lasting_s is None else first_tick(event.at_s + lasting_s, period_s),
        )
        faults.append(fault)
        if event.do not in OF_UAVS:
            down_since.setdefault(target, tick)

    return tuple(sorted(faults, key=lambda fault: fault.tick))


def due(faults: Sequence[Fault], name: str, message: Message) -> Literal["kill", "stop"] | None:
    """Return the fault that a process injects into itself on a message, received or to be sent."""
    if not isinstance(message, Measurement | Tick):
        return None

    for fault in faults:
        is_due = fault.target == name and fault.tick == message.tick
        if is_due and (fault.do == "kill" or fault.do == "stop"):
            return fault.do
    return None
