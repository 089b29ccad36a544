"""Scripted faults of a scenario: what is done to which process, UAV or payload, and when."""

from typing import Annotated, Literal

from annotated_types import Interval
from pydantic import Field

from transport.model.section import Inertia, Key, NotNegative, Positive, Section, Vector

Sensor = Literal["position", "velocity", "attitude", "rate", "specific_force"]


class FaultSection(Section):
    """Fault of a process or a UAV at an instant of the run."""

    at_s: NotNegative
    """scenario time of the fault"""
    do: Literal[
        "kill",
        "stop",
        "continue",
        "restart",
        "motor_off",
        "release",
        "degrade",
        "sensors_off",
        "load",
    ]
    """kill: SIGKILL; stop: SIGSTOP; continue: SIGCONT; restart: start an agent again; motor_off:
    thrust and moments of a UAV are zero; release: it also leaves its rod; degrade: its motors
    produce only a share from then on; sensors_off: some sensors of a UAV measure nothing, with
    `plant.sensors` vehicle; load: mass, inertia or centre of mass of the payload change, unknown to the
    controllers"""
    target: Annotated[
        str, Key(type="coordinator, plant, agent1, agent2, ...; uav1, uav2, ...; or payload")
    ]
    """affected process, UAV for motor_off, release, degrade and sensors_off, or payload for load"""
    efficiency: Annotated[float, Interval(gt=0.0, le=1.0)] | None = None
    """with degrade, and required there: share of the commands that the motors produce"""
    sensors: Annotated[list[Sensor], Field(min_length=1)] | None = None
    """with sensors_off, and required there: the sensors"""
    duration_s: Positive | None = None
    """with sensors_off: time until they measure again, default: never; with load: time over which it
    changes linearly, default: at once"""
    mass_kg: Positive | None = None
    """with load: actual mass of the payload from then on; its inertia changes in proportion if not given"""
    inertia_kgm2: Annotated[Inertia | None, Key(type="3 numbers or 3 rows of 3")] = None
    """with load: actual inertia of the payload about its centre of mass"""
    centre_m: Vector | None = None
    """with load: actual centre of mass, as `plant.payload_centre_m`"""


class FaultsSection(Section):
    """Scripted faults."""

    event: Annotated[list[FaultSection], Key(short="faults")] = []
    """faults, in any order of time"""
