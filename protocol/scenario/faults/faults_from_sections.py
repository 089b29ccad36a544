"""Faults of a scenario as faults of a run, at their ticks."""

from typing import Literal

import numpy as np

from transport.protocol.scenario.faults.faults_by_tick import OF_PLANT, Fault, Load
from transport.protocol.scenario.sections.fault_sections import FaultSection
from transport.protocol.scenario.sections.lockstep_and_realtime_section import first_tick
from transport.protocol.scenario.sections.schema import Scenario


def load_of(event: FaultSection) -> Load:
    """Return the change of the load that an event has."""
    inertia = None
    if event.inertia_kgm2 is not None:
        J = np.array(event.inertia_kgm2)
        inertia = tuple(map(tuple, (np.diag(J) if J.ndim == 1 else J).tolist()))
    return Load(mass_kg=event.mass_kg, inertia_kgm2=inertia, centre_m=event.centre_m)


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
