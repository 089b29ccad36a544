"""Scripted faults of processes and of UAVs.

A process ends or stops itself, and its parent restarts or continues it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from transport.protocol.wire.messages import Measurement, Message, Tick

OF_UAVS = ("motor_off", "release", "degrade", "sensors_off")
OF_PLANT = (*OF_UAVS, "load")  # applied by the plant
_FOR_GOOD = ("motor_off", "release")


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """What a change of the load leads to; None for what stays.

    Without an inertia that of before changes with the mass.
    """

    mass_kg: float | None = None
    inertia_kgm2: tuple[tuple[float, ...], ...] | None = None  # (3, 3)
    centre_m: tuple[float, ...] | None = None  # from the point that controllers take for it, (3,)

    def in_words(self) -> str:
        """Return the values that change."""
        parts = []
        if self.mass_kg is not None:
            parts.append(f"{self.mass_kg:g} kg")
        if self.inertia_kgm2 is not None:
            parts.append("another inertia")
        if self.centre_m is not None:
            parts.append(f"centre of mass at {list(self.centre_m)} m")
        return ", ".join(parts)


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault or return of a process when a tick opens for it, or one of a UAV or the load from then on."""

    tick: int
    do: Literal[
        "kill",
        "stop",
        "continue",
        "start",
        "motor_off",
        "release",
        "degrade",
        "sensors_off",
        "load",
    ]
    target: str  # process name; for faults of UAVs the name of a UAV, such as "uav3"; "payload"
    efficiency: float = 1.0  # of the motors, for "degrade"
    sensors: tuple[str, ...] = ()  # that fail, for "sensors_off"
    # Tick at which these measure again, or None for never; that at which a change of the load is over.
    until: int | None = None
    load: Load = Load()  # for "load"

    @property
    def uav(self) -> int:
        """Return the UAV that is the target, 0-based."""
        return int(self.target.removeprefix("uav")) - 1


def failures(faults: Sequence[Fault]) -> list[Fault]:
    """Return the failures of UAVs for good, in the order of time."""
    return [fault for fault in faults if fault.do in _FOR_GOOD]


def due(faults: Sequence[Fault], name: str, message: Message) -> Literal["kill", "stop"] | None:
    """Return the fault that a process injects into itself on a message, received or to be sent."""
    if not isinstance(message, Measurement | Tick):
        return None

    for fault in faults:
        is_due = fault.target == name and fault.tick == message.tick
        if is_due and (fault.do == "kill" or fault.do == "stop"):
            return fault.do
    return None
