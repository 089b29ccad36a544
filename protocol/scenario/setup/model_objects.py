"""Objects of the model that the sections of a scenario describe."""

import math
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np

from transport.model.arrays import ArrayLike, ShapeError
from transport.model.path.curves import Curve
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import Phase
from transport.model.physics.obstacles import Obstacle, Solid, walls_of_gap
from transport.model.physics.parameters import Kind, ParameterError, Payload, System, Uav
from transport.mpc.program.feedback_law import FeedbackError
from transport.mpc.settings_period_horizon_weights import SettingsError
from transport.protocol.scenario.sections.maneuver_sections import ObstacleSection, PhaseSection
from transport.protocol.scenario.sections.scenario_errors import RequestError, ScenarioError
from transport.protocol.scenario.sections.schema import Scenario, UavSection

T = TypeVar("T")


def building(
    source: str,
    field: str,
    build: Callable[[], T],
    error_class: type[ScenarioError] = ScenarioError,
) -> T:
    """Return a model object built from a scenario's values.

    Raises: ScenarioError: of that field and class, for the errors of the model.
    """
    try:
        return build()
    except (FeedbackError, ParameterError, RequestError, SettingsError, ShapeError) as error:
        raise error_class(source, field, str(error)) from error


def system_of(scenario: Scenario, source: str) -> System:
    """Return the bodies of a scenario as the controllers assume them.

    Raises: ScenarioError, which names the source.
    """
    section = scenario.system
    known = float(scenario.controller.knows_drag)  # share of the drag
    payload = building(
        source,
        "system.payload",
        lambda: Payload(
            mass=section.payload.mass_kg,
            inertia=section.payload.inertia_kgm2,
            drag=known * section.payload.drag_kgps,
        ),
    )
    uavs = []
    for uav in section.uav:
        uavs.append(building(source, f"system.uav.{uav.id}", partial(_uav, uav, known)))

    rate_gains = None
    if scenario.controller.inputs == "rates":
        rate_gains = 1.0 / np.array(scenario.controller.rate_time_constant_s)
    return building(
        source,
        "system",
        lambda: System(
            payload=payload,
            uavs=uavs,
            gravity=section.gravity_mps2,
            rate_gains=rate_gains,
            has_drag=_estimates_drag(scenario),
        ),
    )


def kinds_of(scenario: Scenario) -> set[Kind]:
    """Return the equations of motion of controllers and plant, which may differ.

    The plant has motors, that is thrust and moments, also where controllers command body rates.
    """
    N = len(scenario.system.uav)
    section = scenario.system
    drag = section.payload.drag_kgps > 0.0 or any(any(uav.drag_kgps) for uav in section.uav)
    known = drag and scenario.controller.knows_drag
    rates = scenario.controller.inputs == "rates"
    return {
        Kind(N, rates, known or _estimates_drag(scenario)),
        Kind(N, False, drag and scenario.plant.drag_factor > 0.0),
    }


def _estimates_drag(scenario: Scenario) -> bool:
    """Return whether agents estimate the drag of bodies along a reference that moves fast."""
    section = scenario.controller
    is_estimated = section.disturbance.estimate and section.estimator == "kalman"
    return is_estimated and scenario.maneuver.reference == "flat"


def _uav(section: UavSection, known_drag: float) -> Uav:
    """Return a UAV and its rod, with a share of its drag."""
    return Uav(
        mass=section.mass_kg,
        inertia=section.inertia_kgm2,
        rho=section.rho_m,
        rod_length=section.rod_length_m,
        drag=known_drag * np.array(section.drag_kgps),
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
    table = section.way
    way: Curve | ArrayLike | None = section.curve()
    if way is None and table is not None:
        way = table
        if is_smooth:
            way = Curve(kind=None, duration_s=section.duration_s, ramp_s=0.0, table=table)
    return Phase(
        name=section.name,
        duration_s=section.duration_s,
        kind=section.kind,
        displacement_I=section.displacement_m,
        way=way,
        formation=section.formation,
    )


def obstacle_of(section: ObstacleSection) -> Obstacle:
    """Return an obstacle: one rounded box, or the two walls of a gap."""
    half = np.zeros(3)
    if section.kind == "cylinder":
        half[2] = np.inf
    elif section.size_m is not None:
        half = np.array(section.size_m) / 2.0
    heading_rad = math.radians(section.heading_deg)
    at_I = np.array(section.at_m)
    solids: tuple[Solid, ...]
    if section.width_m is not None:
        solids = walls_of_gap(at_I, heading_rad, section.width_m, section.thickness_m)
    else:
        radius_m = section.radius_m or 0.0
        solids = (Solid(centre_I=at_I, heading_rad=heading_rad, half=half, radius=radius_m),)
    return Obstacle(
        name=section.kind,
        solids=solids,
        margin_m=section.margin_m,
        load_margin_m=section.load_margin_m,
        penalty=section.penalty,
    )
