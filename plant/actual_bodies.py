"""Bodies of the plant as they are: masses, inertias, drag and centre that the controllers do not know."""

import numpy as np

from transport.model.arrays import Array
from transport.model.physics.parameters import Payload, System, Uav
from transport.model.physics.rotations import rotation
from transport.model.state import OMEGA0, R0, THETA0, V0
from transport.plant.plant_run import PlantRun
from transport.protocol.scenario.faults.faults_by_tick import Load
from transport.protocol.scenario.sections.plant_sections import UavFactorsSection


def about(x: Array, point: Array) -> Array:
    """Return a state with place and velocity of another point of the payload.

    Rods and UAVs stay as they are.

    Args:
        x: State, (n,).
        point: The other point from the present one, (3,), payload frame, m.
    Source: docs/equations.md (44a).
    """
    if not point.any():
        return x
    moved = x.copy()
    #   r_c = r_0 + R_0 c,  v_c = v_0 + omega_0 x c
    moved[R0] += rotation(x[THETA0]) @ point
    moved[V0] += np.cross(x[OMEGA0], point)
    return moved


def actual_system(setup: PlantRun) -> System:
    """Return the actual bodies: masses, inertias and drag times factors, the centre of the payload.

    Inputs are moments.
    """
    known = setup.run.system
    section = setup.section
    mass_factor, inertia_factor = section.payload_mass_factor, section.payload_inertia_factor
    if inertia_factor is None:
        inertia_factor = mass_factor
    payload = Payload(
        mass=mass_factor * known.payload.mass,
        inertia=inertia_factor * known.payload.inertia,
        drag=section.drag_factor * setup.bodies.payload.drag_kgps,
        centre=section.payload_centre_m,
    )
    of_one = {one.id: one for one in section.uav}
    uavs = []
    for uav, own in zip(known.uavs, setup.bodies.uav, strict=True):
        one = of_one.get(own.id, UavFactorsSection(id=own.id))
        uavs.append(
            Uav(
                mass=section.uav_mass_factor * one.mass_factor * uav.mass,
                inertia=section.uav_mass_factor * one.inertia * uav.inertia,
                rho=uav.rho - payload.centre,
                rod_length=uav.rod_length,
                drag=section.drag_factor * one.drag_factor * np.array(own.drag_kgps),
            )
        )
    return System(payload=payload, uavs=uavs, gravity=known.gravity)


def payload_during(change: Load, before: Payload, share: float) -> Payload:
    """Return the payload after a share, 0 to 1, of a change from the one before.

    Without an inertia that of before changes with the mass.
    Raises: ParameterError: there is no such body.
    """
    mass = before.mass if change.mass_kg is None else change.mass_kg
    inertia = mass / before.mass * before.inertia
    if change.inertia_kgm2 is not None:
        inertia = np.array(change.inertia_kgm2)
    centre = before.centre if change.centre_m is None else np.array(change.centre_m)
    return Payload(
        mass=before.mass + share * (mass - before.mass),
        inertia=before.inertia + share * (inertia - before.inertia),
        drag=before.drag,
        centre=before.centre + share * (centre - before.centre),
    )
