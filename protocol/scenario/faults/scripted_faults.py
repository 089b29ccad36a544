"""Scripted faults of processes and of UAVs.

A process ends or stops itself, and its parent restarts or continues it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from transport.model.parameters import Payload
from transport.protocol.scenario.sections.clock_section import first_tick
from transport.protocol.scenario.sections.schema import FaultSection, Scenario
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

    def between(self, before: Payload, share: float) -> Payload:
        """Return the payload after a share, 0 to 1, of the change from the one before.

        Raises: ParameterError: there is no such body.
        """
        mass = before.mass if self.mass_kg is None else self.mass_kg
        inertia = mass / before.mass * before.inertia
        if self.inertia_kgm2 is not None:
            inertia = np.array(self.inertia_kgm2)
        centre = before.centre if self.centre_m is None else np.array(self.centre_m)
        return Payload(
            mass=before.mass + share * (mass - before.mass),
            inertia=before.inertia + share * (inertia - before.inertia),
            drag=before.drag,
            centre=before.centre + share * (centre - before.centre),
        )

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


def load_of(event: FaultSection) -> Load:
    """Return the change of the load that an event has."""
    inertia = None
    if event.inertia_kgm2 is not None:
        J = np.array(event.inertia_kgm2)
        inertia = tuple(map(tuple, (np.diag(J) if J.ndim == 1 else J).tolist()))
    return Load(mass_kg=event.mass_kg, inertia_kgm2=inertia, centre_m=event.centre_m)


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
            load=load_of(event),
        )
        faults.append(fault)
        if event.do not in OF_PLANT:
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
