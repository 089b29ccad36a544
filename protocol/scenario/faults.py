"""Scripted faults of processes, which kill or stop themselves and are brought back by their parent, and of UAVs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from transport.protocol.scenario.schema import Scenario
from transport.protocol.wire.messages import Measurement, Message, Tick

OF_UAVS = ("motor_off", "release", "degrade")  # applied by the plant


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
    """Return the faults of a scenario in the order of time.

    A restart is a kill, unless already down, and a start.
    """
    found: list[Fault] = []
    down: dict[str, int] = {}  # processes that do not run, and since which tick
    for event in sorted(scenario.faults.event, key=lambda event: event.at_s):
        tick, target = (
            math.ceil(event.at_s / scenario.controller.sampling_period_s - 1e-9),
            event.target,
        )
        if event.do == "restart" or event.do == "continue":
            if target not in down:
                found.append(Fault(tick, "kill", target))
            tick = max(tick, down.pop(target, tick) + 1)  # at the earliest
            found.append(Fault(tick, "start" if event.do == "restart" else "continue", target))
        else:
            found.append(Fault(tick, event.do, target, event.efficiency or 1.0))
            if event.do not in OF_UAVS:
                down.setdefault(target, tick)
    return tuple(sorted(found, key=lambda fault: fault.tick))


def due(faults: Sequence[Fault], name: str, message: Message) -> Literal["kill", "stop"] | None:
    """Return the fault a process is to inject into itself on a message received or about to be sent, if any."""
    for fault in faults if isinstance(message, Measurement | Tick) else ():
        if (
            fault.target == name
            and fault.tick == message.tick
            and (fault.do == "kill" or fault.do == "stop")
        ):
            return fault.do
    return None
