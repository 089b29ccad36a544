"""Section of a scenario about vehicles: processes between the agents and autopilots."""

from typing import Annotated, Literal

from annotated_types import Interval

from transport.model.section import Key, Positive, Section, Vector

# UDP port of the link to the autopilot of UAV 1, then UAV 2, ..., where none is given.
DEFAULT_VEHICLE_PORT = 14550


class VehiclesSection(Section):
    """Processes of the UAVs, with `plant.kind` vehicles or `plant.autopilot`."""

    autopilot: Literal["ardupilot", "px4", "betaflight"] = "ardupilot"
    """autopilot of each UAV, which decides modes, parameters and throttle ([flight.md](../flight.md))"""
    thrust_N: Positive | None = None
    """thrust of a UAV at full throttle; default: the upper limit of `controller.limits.thrust_N`"""
    parameters: Annotated[dict[str, float], Key(type="table of numbers by name")] = {}
    """parameters that each autopilot must have, beside those that this project always needs"""
    origin: Annotated[Vector, Key(unit="deg, deg, m")] = (47.0, 8.0, 0.0)
    """latitude, longitude and height of the common frame, told to the autopilots before their
    estimators choose one"""
    setpoint_hz: Annotated[float, Interval(ge=20.0, le=400.0)] = 60.0
    """setpoints of thrust and body rates a second; a multiple of the ticks' rate has one at the first
    instant of each plan"""
    setpoint_timeout_s: Annotated[float, Interval(ge=0.1, le=3.0)] = 0.5
    """time without a setpoint after which the autopilot levels its UAV by itself"""
    stale_s: Annotated[float, Interval(gt=0.0, le=1.0)] = 0.25
    """age of an autopilot's state from which on its UAV gets no setpoints by its own law"""
    jump_m: Positive = 0.5
    """change of the estimated position beyond its velocity that counts as a jump of the estimate,
    not as motion"""
    distance_m: Positive = 0.5
    """largest difference of the distances between UAVs from those of the hover before the start"""
    clock_offset_s: Annotated[float, Interval(gt=0.0, le=1.0)] = 0.01
    """largest offset of the clock of a vehicle's host from the coordinator's before the start"""
    hover_share: Annotated[float, Interval(ge=0.0, lt=1.0)] = 0.15
    """largest difference of the thrust with which each autopilot hovers by itself before the start from
    the weight that its UAV carries, as a share of it; 0: not compared"""
    battery: Annotated[float, Interval(ge=0.0, lt=1.0)] = 0.25
    """least share of the battery before the start"""
    battery_land: Annotated[float, Interval(ge=0.0, lt=1.0)] = 0.15
    """share of the battery of any UAV below which the whole team lands where it is, as by `transport land`"""
    at_end: Literal["hold", "land"] = "hold"
    """what each autopilot is asked to do by itself once the run has ended in order; after any other
    end it holds its place. UAVs on rods that hold by themselves drift against each other: end a
    maneuver where its load may be set down"""
    landing_s: Annotated[float, Interval(ge=60.0, le=36_000.0)] = 600.0
    """with `plant.kind` vehicles, time after the maneuver in which the team comes down by itself, and is
    released by a person: the run ends with `transport release`, and after this time without it"""
    ready_s: Annotated[float, Interval(gt=0.0, le=1e6)] = 180.0
    """time that the vehicles have to be ready, of wall time; the run ends after it, with what is missing"""
