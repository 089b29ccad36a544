"""Sections of a scenario about the plant: engine, bodies, motors, wind, sensors."""

from typing import Annotated, Any, Literal

from annotated_types import Interval
from pydantic import model_validator

from transport.model.section import (
    LAG_S,
    Key,
    NotNegative,
    NotNegativeVector,
    Positive,
    Range,
    Section,
    Vector,
)
from transport.protocol.scenario.user_class.user_import import or_class

_NOISE = (1e-12, 1e4)
MassFactor = Annotated[float, Interval(gt=0.0, le=100.0)]


class MujocoSection(Section):
    """Bodies and integration of the engine "mujoco"."""

    step_s: Annotated[float, Interval(gt=0.0, le=0.01)] = 0.005
    """longest integration step; a period is divided into equal steps. Contacts need steps of at
    most 0.01 s"""
    rod_mass_kg: Annotated[float, Interval(ge=1e-4, le=100.0)] = 0.001
    """mass of each rod, unknown to the controllers; with the default the payload's path is that of
    massless rods within a millimetre"""
    suspension: Literal["rods", "cables"] = "rods"
    """rods, or cables, which have no mass, pull at their full length and never push"""


class RotorsSection(Section):
    """Four equal rotors of every UAV, on arms at 45 deg to its axes, and their limits."""

    arm_m: Positive
    """distance of each rotor from the centre of the UAV; arms at 45 deg to its axes"""
    drag_to_thrust_m: Positive
    """drag moment of a rotor over its thrust"""
    thrust_N: Range
    """smallest and largest thrust of one rotor; a quarter of the hover thrust of each UAV must lie
    between them"""


class MotorsSection(Section):
    """Difference of the actual inputs of all UAVs from their commands."""

    lag_s: Annotated[NotNegative, Key(within=LAG_S, label="motor lag", shown="ms")] = 0.0
    """time constant of thrust and moments; 0, or at least a hundredth of T_s"""
    falling_lag_s: Annotated[
        Positive | None, Key(within=LAG_S, label="motor lag of falling thrust", shown="ms")
    ] = None
    """time constant of a rotor whose thrust falls, `lag_s` is then that of rising thrust; default:
    `lag_s`. Needs `lag_s` > 0 and `[plant.motors.rotors]`"""
    thrust_step_N: Annotated[NotNegative, Key(label="thrust step")] = 0.0
    """the thrust of a UAV is rounded to multiples of this step; 0: any thrust"""
    rotors: RotorsSection | None = None


class WindSection(Section):
    """Moving air, inertial frame, and a drag of the bodies in it that no controller knows."""

    speed_mps: Annotated[Vector, Key(label="wind speed", short="wind_mps")] = (0.0, 0.0, 0.0)
    """mean velocity of the air, inertial frame"""
    gust_mps: Annotated[
        NotNegativeVector, Key(label="gusts, standard deviation", short="gust_mps")
    ] = (0.0, 0.0, 0.0)
    """standard deviation of the gusts about it, per inertial axis"""
    gust_time_constant_s: Annotated[Positive, Key(label="correlation time of gusts")] = 2.0
    """correlation time of the gusts"""
    drag_payload_kgps: NotNegative | None = None
    """drag of a payload, and `drag_uav_kgps` of UAVs, whose `[system]` has none: no controller knows
    it. At most mass over T_s. By default 0.4 in wind or gusts, none in still air"""
    drag_uav_kgps: NotNegative | None = None
    """the same of each UAV, by default 0.2 in wind or gusts"""


class BiasSection(Section):
    """Standard deviations of constant sensor errors, with `plant.sensors` vehicle."""

    position_m: Annotated[NotNegative, Key(within=_NOISE)] = 0.0
    """standard deviation of the bias of positions"""
    velocity_mps: NotNegative = 0.0
    """standard deviation of the bias of velocities"""
    attitude_rad: NotNegative = 0.0
    """standard deviation of the bias of attitudes"""
    rate_rads: NotNegative = 0.0
    """standard deviation of the bias of body rates"""
    specific_force_mps2: NotNegative = 0.0
    """standard deviation of the bias of specific forces"""


class DelaySection(Section):
    """Ages of a vehicle's measurements, with `plant.sensors` vehicle, in whole sampling periods."""

    position_s: Annotated[
        float, Interval(ge=0.0, le=1.0), Key(label="delay of positions", shown="ms")
    ] = 0.0
    """age of positions"""
    velocity_s: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.0
    """age of velocities"""
    attitude_s: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.0
    """age of attitudes"""
    rate_s: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.0
    """age of body rates"""
    specific_force_s: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.0
    """age of specific forces"""


class NoiseSection(Section):
    """Errors of the measurements: white noise; with `plant.sensors` vehicle also bias and delay."""

    position_m: Annotated[
        NotNegative, Key(within=_NOISE, label="noise of payload position", shown="mm")
    ] = 0.0
    """noise of the payload position; of UAV positions with `plant.sensors` vehicle"""
    velocity_mps: Annotated[NotNegative, Key(label="noise of payload velocity", shown="mm/s")] = 0.0
    """noise of the payload velocity; of UAV velocities with `plant.sensors` vehicle"""
    attitude_rad: Annotated[NotNegative, Key(label="noise of attitudes")] = 0.0
    """noise of the attitudes of payload and UAVs"""
    rate_rads: Annotated[NotNegative, Key(label="noise of angular velocities")] = 0.0
    """noise of the angular velocities of payload and UAVs"""
    rod_direction_rad: NotNegative = 0.0
    """noise of the rod directions"""
    rod_rate_rads: NotNegative = 0.0
    """noise of the rod rates"""
    specific_force_mps2: Annotated[NotNegative, Key(label="noise of specific forces")] = 0.0
    """noise of the specific forces of the UAVs, with `plant.sensors` vehicle"""
    bias: BiasSection = BiasSection()
    delay: DelaySection = DelaySection()


class UavFactorsSection(Section):
    """What differs at one UAV from what the controllers assume."""

    id: Annotated[int, Interval(ge=1)]
    """number of the UAV"""
    mass_factor: MassFactor = 1.0
    """actual mass over the assumed one, on top of `plant.uav_mass_factor`"""
    inertia_factor: MassFactor | None = None
    """the same of the inertia; default: `mass_factor`"""
    thrust_factor: Annotated[float, Interval(gt=0.0, le=10.0)] = 1.0
    """thrust and moments that the motors produce over their commands"""
    drag_factor: Annotated[float, Interval(ge=0.0, le=100.0)] = 1.0
    """actual drag over the assumed one, on top of `plant.drag_factor`"""

    @property
    def inertia(self) -> float:
        """Actual inertia over the assumed one."""
        return self.mass_factor if self.inertia_factor is None else self.inertia_factor


class PlantSection(Section):
    """Ground truth: integration, differences from the controller's model, limits of divergence."""

    kind: Literal["simulated", "vehicles"] = "simulated"
    """simulated: one process is the team; vehicles: there is none, each UAV has a process between its
    agent and its autopilot ([flight.md](../flight.md))"""
    autopilot: Literal["ardupilot", "betaflight", "stand_in"] | None = None
    """autopilots fly the simulated UAVs, a program for each, with the same processes of vehicles as
    outside: ArduCopter, named by the environment variable ARDUCOPTER, Betaflight on its real links,
    whose place a motion capture tells, or a stand-in of this project for tests. Default: none, the
    plant follows the plans itself. With `kind` vehicles it is left out: the same file flies outside"""
    engine: Annotated[
        str, or_class("rods", "mujoco"), Key(type="rods, mujoco, package.module:Class")
    ] = "rods"
    """the controllers' own equations, MuJoCo ([engines.md](../engines.md) compares them), or [your own
    class](../own-process.md#your-own-engine)"""
    ground_m: float | None = None
    """z of a level ground, inertial frame (z down), for engines with contacts, so not rods. The
    payload is a box that reaches to its attachment points, a UAV a sphere of 0.1 m"""
    mujoco: MujocoSection = MujocoSection()
    step_s: Annotated[Positive, Key(label="integration step", shown="ms")] = 0.01
    """longest integration step of rods; a period is divided into equal steps"""
    tolerance: Annotated[float, Interval(ge=1e-12, le=10.0), Key(unit="SI")] = 1e-9
    """local error above which an integration step of rods is halved, [equations.md](../equations.md)
    (13c)"""
    max_attitude_deg: Annotated[float, Interval(gt=0.0, lt=90.0)] = 80.0
    """roll or pitch of the payload or a UAV beyond which the run counts as diverged"""
    max_error_m: Positive = 20.0
    """distance of the payload from its path beyond which the run counts as diverged"""
    on_collision: Literal["continue", "end"] = "continue"
    """when two UAVs touch (`system.uav.radius_m`): the run goes on, as if they went through each other, or
    ends. The exit code is 11 in both cases"""
    payload_mass_factor: Annotated[
        MassFactor, Key(label="actual over assumed payload mass", short="payload_mass_factor")
    ] = 1.0
    """actual mass and inertia of the payload over those of `[system.payload]`, which the controller
    assumes"""
    payload_inertia_factor: Annotated[
        MassFactor | None, Key(label="actual over assumed payload inertia")
    ] = None
    """the same of the inertia alone; default: `payload_mass_factor`"""
    payload_centre_m: Annotated[Vector, Key(label="centre of mass of the payload")] = (
        0.0,
        0.0,
        0.0,
    )
    """actual centre of mass of the payload, payload frame, from the point that the controllers take for
    it, which follows the path"""
    uav: list[UavFactorsSection] = []
    uav_mass_factor: Annotated[MassFactor, Key(label="actual over assumed UAV mass")] = 1.0
    """actual mass and inertia of every UAV over those that the controller assumes"""
    drag_factor: Annotated[
        float, Interval(ge=0.0, le=100.0), Key(label="actual over assumed drag")
    ] = 1.0
    """actual drag of payload and UAVs over that of `[system]`, which the controller assumes"""
    inner_loop: Literal["model", "betaflight"] = "model"
    """moments from commanded body rates, with `controller.inputs=rates`: by the loop that
    controllers predict with, or the flight firmware Betaflight, a process for each UAV
    ([engines.md](../engines.md#flight-firmware))"""
    motors: MotorsSection = MotorsSection()
    wind: WindSection = WindSection()
    sensors: Literal["state", "vehicle"] = "state"
    """measurements of an agent: the states of payload, own UAVs and rods; or what an autopilot has
    of each own UAV ([equations](../equations/estimation.md#estimation-without-a-payload-sensor))"""
    noise: NoiseSection = NoiseSection()

    @model_validator(mode="before")
    @classmethod
    def _outside(cls, value: Any) -> Any:
        """Leave out the autopilots of a simulation where there is none.

        `--set plant.kind=vehicles` lets the file of a simulated flight fly outside.
        """
        if isinstance(value, dict) and value.get("kind") == "vehicles":
            return {key: one for key, one in value.items() if key != "autopilot"}
        return value
