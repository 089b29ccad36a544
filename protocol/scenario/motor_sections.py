"""Sections of a scenario about the motors of the plant."""

from typing import Annotated

from pydantic import AfterValidator
from pydantic_core import PydanticCustomError

from mpc.settings import NotNegative, Positive
from protocol.scenario.sections import Section


def _range(value: list[float]) -> list[float]:
    if len(value) != 2 or not value[0] < value[1]:
        raise PydanticCustomError("range", "expected [smallest, largest] with smallest < largest")
    return value


class RotorsSection(Section):
    """Four equal rotors of every UAV, on arms at 45 deg to its axes, and the limits of their thrusts."""

    arm_m: Positive
    drag_to_thrust_m: Positive
    thrust_N: Annotated[list[NotNegative], AfterValidator(_range)]


class MotorsSection(Section):
    """Difference of the actual inputs of all UAVs from their commands."""

    lag_s: NotNegative = 0.0
    thrust_step_N: NotNegative = 0.0
    rotors: RotorsSection | None = None
