"""Settings of Betaflight with which body rates follow with the scenario's time constants."""

import math
from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array
from transport.model.physics.parameters import Uav
from transport.plant.plant_run import PlantRun
from transport.plant.rotors_and_motors import Rotors
from transport.protocol.scenario.sections.plant_sections import RotorsSection

# Output of the motors when armed, and the channel of the throttle from which it rises, us.
IDLE = 0.055
IDLE_THROTTLE_US = 1050
_IDLE_UNIT = 1e-4  # of the setting `motor_idle`
# Settings of the firmware that are not its defaults, for every UAV. The receiver's channels are
# body rates as they are, without smoothing or lead: the controllers already plan with the inner
# loop. AUX1 arms.
SETTINGS = f"""\
aux 0 0 0 1700 2100 0 0
set pwr_on_arm_grace = 0
set small_angle = 180
set runaway_takeoff_prevention = OFF
set blackbox_device = NONE
set rc_smoothing = OFF
set rates_type = ACTUAL
set simplified_pids_mode = OFF
set min_check = {IDLE_THROTTLE_US}
set motor_idle = {round(IDLE / _IDLE_UNIT)}""".splitlines()
_ROTORS = 4  # of each UAV
_AXES = ("roll", "pitch", "yaw")
# Units of the firmware's gains, per deg/s, deg and deg/s^2 (its flight/pid.h), as shares of full
# output.
_P = 0.032029e-3
_I = 0.244381e-3
_D = 0.000529e-3
# Integral over proportional gain, in 1/time constant, and derivative over proportional gain, s.
# With the ratios of the firmware's defaults, 0.5 at 40 ms and 0.011, rates overshoot by an eighth;
# the model has neither term.
_INTEGRAL = 0.04
_DERIVATIVE_S = 0.004
_LARGEST_GAIN = 250
# Least value of 1 - K d_s (`AxisGains.of`): below a time constant of 8 ms the gains do not grow further
# towards the pole at 4 ms.
_LEAST_SHARE = 0.5
# Ratio of drag moment to thrust of a rotor, over its arm, where the scenario names no rotors.
_DRAG_PER_ARM = 0.1
# Settings of rates: their unit, deg/s, and the largest one.
_RATE_UNIT_DEG_S = 10.0
_LARGEST_RATE = 200


def rotors_of(setup: PlantRun) -> list[RotorsSection]:
    """Return the rotors of each UAV, as the scenario names them or else assumed."""
    section = setup.section.motors.rotors
    uav_most_N = setup.run.settings.limits.thrust_N[1]
    return [section or _assumed_rotors(uav, uav_most_N) for uav in setup.run.system.uavs]


def _assumed_rotors(uav: Uav, uav_most_N: float) -> RotorsSection:
    """Return the rotors of a UAV whose scenario names none: its mass sits at their places."""
    arm_m = math.sqrt(2.0 * uav.inertia[0, 0] / uav.mass)
    return RotorsSection(
        arm_m=arm_m,
        drag_to_thrust_m=_DRAG_PER_ARM * arm_m,
        thrust_N=(0.0, uav_most_N / _ROTORS),
    )


def rate_settings(setup: PlantRun) -> list[int]:
    """Return the settings of the largest rates about roll, pitch and yaw, 10 deg/s.

    Full sticks are at least the limits of the commands.
    """
    limits = np.degrees(setup.run.settings.limits.rates_rads) / _RATE_UNIT_DEG_S
    return [min(math.ceil(limit), _LARGEST_RATE) for limit in limits]


def largest_rates_rads(setup: PlantRun) -> Array:
    """Return the rates of full sticks about roll, pitch and yaw, (3,), rad/s."""
    return np.radians([_RATE_UNIT_DEG_S * rate for rate in rate_settings(setup)])


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisGains:
    """Gains of one axis, per rad/s of the error, per rad of its integral, and per rad/s^2 of the rate.

    In shares of the full output.
    """

    p: float
    i: float
    d: float

    @staticmethod
    def of(time_constant_s: float, inertia_kgm2: float, moment_per_output_Nm: float) -> "AxisGains":
        """Return the gains with which a body rate follows its command with a time constant.

        A unit of the axis' output makes the moment b. With gains p of the error and d = d_s p of the measured rate,

            J omega' = b (p (command - omega) - d omega')

        is omega' = K (command - omega) with K = p b / (J + d b), so p = K J / (b (1 - K d_s)).
        """
        K = 1.0 / time_constant_s
        share = max(1.0 - K * _DERIVATIVE_S, _LEAST_SHARE)
        p = K * inertia_kgm2 / moment_per_output_Nm / share
        return AxisGains(p=p, i=_INTEGRAL * K * p, d=_DERIVATIVE_S * p)

    def settings(self, axis: str) -> dict[str, int]:
        """Return the firmware's settings of an axis, which it takes in units of its own, per degree."""
        by_name = {f"p_{axis}": (self.p, _P), f"i_{axis}": (self.i, _I), f"d_{axis}": (self.d, _D)}
        # The firmware takes no larger gains; rates then follow more slowly.
        return {
            name: min(round(math.radians(gain) / unit), _LARGEST_GAIN)
            for name, (gain, unit) in by_name.items()
        }


def moments_per_output_Nm(section: RotorsSection, hover_thrust_N: float) -> Array:
    """Return the moments about roll, pitch and yaw that a unit of their outputs makes at hover, (3,), N m.

    The thrust of a rotor is T = T_max o^2 at an output o, so at hover

        dT/do = 2 T_max o = 2 sqrt(T T_max),   b = dT/do sum |mixing|
    """
    rotor_most_N = section.thrust_N[1]
    rotor_N = hover_thrust_N / _ROTORS
    thrust_per_output_N = 2.0 * math.sqrt(rotor_N * rotor_most_N)
    return np.asarray(thrust_per_output_N * np.abs(Rotors(section).mixing[1:]).sum(axis=1))


def tuning(setup: PlantRun, uav: Uav, section: RotorsSection, hover_thrust_N: float) -> list[str]:
    """Return the lines of rates and gains with which body rates follow with the scenario's time constants."""
    moments_Nm = moments_per_output_Nm(section, hover_thrust_N)
    time_constants_s = setup.run.settings.rate_time_constant_s
    rates = rate_settings(setup)

    lines = []
    for axis, name in enumerate(_AXES):
        gains = AxisGains.of(time_constants_s[axis], uav.inertia[axis, axis], moments_Nm[axis])
        given = {
            f"{name}_rc_rate": rates[axis],
            f"{name}_srate": rates[axis],
            f"{name}_expo": 0,  # rates in proportion to the stick
            f"f_{name}": 0,  # without feedforward
            **gains.settings(name),
            f"d_max_{name}": 0,  # the derivative gain does not grow in quick turns
        }
        lines += [f"set {key} = {value}" for key, value in given.items()]
    return lines
