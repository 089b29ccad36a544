"""Objects of the model that the sections of a scenario describe."""

import math
from functools import partial

import numpy as np

from transport.model.curves import Curve
from transport.model.maneuver import Maneuver, Phase
from transport.model.obstacles import Obstacle, Solid
from transport.model.parameters import Payload, System, Uav
from transport.protocol.scenario.errors import building
from transport.protocol.scenario.maneuver_sections import ObstacleSection, PhaseSection
from transport.protocol.scenario.schema import Scenario, UavSection

_WALL_M = 1e5  # width of the walls beside a gap: no path comes near their ends


def system_of(scenario: Scenario, source: str) -> System:
    """Return the bodies of a scenario. Raises: ScenarioError, which names the source."""
    section = scenario.system
    payload = building(
        source,
        "system.payload",
        lambda: Payload(mass=section.payload.mass_kg, inertia=section.payload.inertia_kgm2),
    )
    uavs = []
    for uav in section.uav:
        uavs.append(building(source, f"system.uav.{uav.id}", partial(_uav, uav)))

    rate_gains = None
    if scenario.controller.inputs == "rates":
        rate_gains = 1.0 / np.array(scenario.controller.rate_time_constant_s)
    return building(
        source,
        "system",
        lambda: System(
            payload=payload, uavs=uavs, gravity=section.gravity_mps2, rate_gains=rate_gains
        ),
    )


def _uav(section: UavSection) -> Uav:
    """Return a UAV and its rod."""
    return Uav(
        mass=section.mass_kg,
        inertia=section.inertia_kgm2,
        rho=section.rho_m,
        rod_length=section.rod_length_m,
    )


def maneuver_of(scenario: Scenario) -> Maneuver:
    """Return the path of the payload. Raises: ParameterError."""
    section = scenario.maneuver
    is_smooth = section.profile == "smooth"
    return Maneuver(
        start_I=section.start_m,
        phases=[_phase(phase, is_smooth=is_smooth) for phase in section.phase],
        profile=section.profile,
        press_m=section.press_m,
    )


def _phase(section: PhaseSection, *, is_smooth: bool) -> Phase:
    """Return a phase; a table of a smooth path is a spline."""
    curve = section.curve()
    way = section.way
    if curve is None and way is not None and is_smooth:
        curve = Curve(kind=None, duration_s=section.duration_s, ramp_s=0.0, table=way)
        way = None
    return Phase(
        name=section.name,
        duration_s=section.duration_s,
        kind=section.kind,
        displacement_I=section.displacement_m,
        way=way,
        curve=curve,
        formation=section.formation,
    )


def obstacle_of(section: ObstacleSection) -> Obstacle:
    """Return an obstacle: one rounded box, or the two walls of a gap."""
    heading_rad = math.radians(section.heading_deg)
    half = np.zeros(3)
    shifts_m = [0.0]
    if section.kind == "cylinder":
        half[2] = np.inf
    elif section.size_m is not None:
        half = np.array(section.size_m) / 2.0
    elif section.width_m is not None:
        half = np.array([section.thickness_m / 2.0, _WALL_M, np.inf])
        shifts_m = [sign * (section.width_m / 2.0 + _WALL_M) for sign in (-1.0, 1.0)]

    across = np.array([-math.sin(heading_rad), math.cos(heading_rad), 0.0])
    solids = []
    for shift_m in shifts_m:
        solid = Solid(
            centre_I=section.at_m + shift_m * across,
            heading_rad=heading_rad,
            half=half,
            radius=section.radius_m or 0.0,
        )
        solids.append(solid)
    return Obstacle(
        name=section.kind,
        solids=tuple(solids),
        margin_m=section.margin_m,
        load_margin_m=section.load_margin_m,
        penalty=section.penalty,
    )
