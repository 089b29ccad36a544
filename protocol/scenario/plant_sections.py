"""Sections of a scenario about the plant: engine, bodies, wind, sensors."""

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from mpc.settings import NotNegative, Positive
from protocol.scenario.motor_sections import MotorsSection
from protocol.scenario.sections import NotNegativeVector, Section, Vector


def _engine(value: str) -> str:
    if value in ("rods", "mujoco") or re.fullmatch(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*", value):
        return value
    raise PydanticCustomError("engine", "expected 'rods', 'mujoco' or 'package.module:Class'")


MassFactor = Annotated[float, Field(gt=0.0, le=100.0)]


class WindSection(Section):
    """Moving air, inertial frame, and the drag of the bodies in it."""

    speed_mps: Vector = [0.0, 0.0, 0.0]
    gust_mps: NotNegativeVector = [0.0, 0.0, 0.0]
    gust_time_constant_s: Positive = 2.0
    drag_payload_kgps: NotNegative = 0.4
    drag_uav_kgps: NotNegative = 0.2


class NoiseSection(Section):
    """Standard deviations of the measurements."""

    position_m: NotNegative = 0.0
    velocity_mps: NotNegative = 0.0
    attitude_rad: NotNegative = 0.0
    rate_rads: NotNegative = 0.0
    rod_direction_rad: NotNegative = 0.0
    rod_rate_rads: NotNegative = 0.0


class MujocoSection(Section):
    """Bodies and integration of the engine "mujoco"."""

    step_s: Positive = 0.005
    rod_mass_kg: Annotated[float, Field(ge=1e-4, le=100.0)] = 0.001
    suspension: Literal["rods", "cables"] = "rods"


class PlantSection(Section):
    """Ground truth: its integration, its difference from the controller's model, limits beyond which a run diverged."""

    engine: Annotated[str, AfterValidator(_engine)] = "rods"
    ground_m: float | None = None
    mujoco: MujocoSection = MujocoSection()
    step_s: Positive = 0.01
    tolerance: Annotated[float, Field(ge=1e-12, le=10.0)] = 1e-9
    max_attitude_deg: Annotated[float, Field(gt=0.0, lt=90.0)] = 80.0
    max_error_m: Positive = 20.0
    payload_mass_factor: MassFactor = 1.0
    uav_mass_factor: MassFactor = 1.0
    motors: MotorsSection = MotorsSection()
    wind: WindSection = WindSection()
    noise: NoiseSection = NoiseSection()
