"""Scripted faults: kills, stops and restarts of processes, failures of UAVs, each at a tick.

A process kills or stops itself on the message that opens the tick for it; its parent restarts or continues it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from protocol.scenario.schema import Scenario
from protocol.wire.messages import Measurement, Message, Tick

# Faults that the plant applies to its UAVs.
OF_UAVS = ("motor_off", "release", "degrade")


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of a process when the tick opens for it, its return before that, or a fault of a UAV from then on."""

    tick: int
    do: Literal["kill", "stop", "continue", "start", "motor_off", "release", "degrade"]
    target: str  # process name; for faults of UAVs the name of a UAV, such as "uav3"
    efficiency: float = 1.0  # of the motors, for "degrade"

    @property
    def uav(self) -> int:
        """Return the UAV that is the target, 0-based."""
        return int(self.target.removeprefix("uav")) - 1


def failures(faults: Sequence[Fault]) -> list[Fault]:
    """Return the failures of UAVs for good, in the order of time."""
    return [fault for fault in faults if fault.do in ("motor_off", "release")]


def scripted(scenario: Scenario) -> tuple[Fault, ...]:
    """Return the faults of a scenario in the order of time; a restart is a kill, unless already down, and a start."""
    period_s = scenario.controller.sampling_period_s
    found: list[Fault] = []
    down: dict[str, int] = {}  # processes that do not run, and since which tick
    for event in sorted(scenario.faults.event, key=lambda event: event.at_s):
        tick, target = math.ceil(event.at_s / period_s - 1e-9), event.target
        if event.do == "restart" or event.do == "continue":
            if target not in down:
                found.append(Fault(tick, "kill", target))
            # A process is back at the next tick at the earliest.
            tick = max(tick, down.pop(target, tick) + 1)
            found.append(Fault(tick, "start" if event.do == "restart" else "continue", target))
        else:
            found.append(Fault(tick, event.do, target, event.efficiency or 1.0))
            if event.do not in OF_UAVS:
                down.setdefault(target, tick)
    return tuple(sorted(found, key=lambda fault: fault.tick))


def due(faults: Sequence[Fault], name: str, message: Message) -> Literal["kill", "stop"] | None:
    """Return the fault a process is to inject into itself on a message received or about to be sent, if any."""
    if isinstance(message, Measurement | Tick):
        for fault in faults:
            if fault.target == name and fault.tick == message.tick and (fault.do == "kill" or fault.do == "stop"):
                return fault.do
    return None
