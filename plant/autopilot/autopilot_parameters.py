"""Parameters of ArduCopter with which its body rates follow with the scenario's time constants."""

import math

from transport.model.physics.parameters import Uav
from transport.plant.plant_run import PlantRun
from transport.protocol.scenario.sections.plant_sections import RotorsSection

# Integral over proportional gain of roll, pitch and yaw, 1/s.
_INTEGRAL = (0.5, 0.5, 0.1)
_AXES = ("RLL", "PIT", "YAW")
# Values that are no property of the vehicle: what this project depends on, no radio control, no
# ground station, sensors without the offsets of a calibration that simulated ones do not need, no
# log of its own, and a height that it holds softly by itself: stiffly held, that of one UAV tilts the load.
_ALWAYS = {
    "FRAME_CLASS": 1.0,
    "FRAME_TYPE": 1.0,
    "SCHED_LOOP_RATE": 400.0,
    "MOT_THST_EXPO": 1.0,
    "MOT_SPIN_MIN": 0.0,
    "MOT_SPIN_ARM": 0.0,
    "MOT_SPIN_MAX": 1.0,
    "MOT_PWM_MIN": 1000.0,
    "MOT_PWM_MAX": 2000.0,
    "MOT_BAT_VOLT_MAX": 0.0,
    "MOT_BAT_VOLT_MIN": 0.0,
    "MOT_HOVER_LEARN": 0.0,
    "MOT_SPOOL_TIME": 0.25,
    "ATC_ANGLE_BOOST": 0.0,
    "EK3_POS_I_GATE": 200.0,
    "ATC_RAT_YAW_FLTE": 0.0,
    "ATC_RAT_RLL_FLTT": 0.0,
    "ATC_RAT_PIT_FLTT": 0.0,
    "ATC_RAT_YAW_FLTT": 0.0,
    "INS_GYRO_FILTER": 80.0,
    "SERIAL1_PROTOCOL": 2.0,
    "SERIAL2_PROTOCOL": -1.0,
    "GUID_OPTIONS": 8.0,
    "PSC_POSZ_P": 0.3,
    "PSC_VELZ_P": 1.5,
    "PSC_ACCZ_I": 0.25,
    # The same three as releases from 4.7 on name and scale them; each ignores the names of the other.
    "PSC_D_POS_P": 0.3,
    "PSC_D_VEL_P": 1.5,
    "PSC_D_ACC_I": 0.025,
    "FS_GCS_ENABLE": 0.0,
    "FS_THR_ENABLE": 0.0,
    "FS_EKF_ACTION": 1.0,
    "FS_CRASH_CHECK": 0.0,
    "DISARM_DELAY": 0.0,
    "ARMING_CHECK": 1.0,
    "SIM_BARO_RND": 0.0,
    "LOG_DISARMED": 0.0,
    "LOG_BACKEND_TYPE": 0.0,
    **{
        f"INS_ACC{number}{kind}_{axis}": value
        for number in ("", "2")
        for kind, value in (("OFFS", 0.001), ("SCAL", 1.001))
        for axis in "XYZ"
    },
    **{
        f"COMPASS_OFS{number}_{axis}": value
        for number in ("", "2", "3")
        for axis, value in (("X", 5.0), ("Y", 13.0), ("Z", -18.0))
    },
}


def parameters(
    setup: PlantRun, uav: Uav, rotors: RotorsSection, hover_N: float, rate_hz: float
) -> dict[str, float]:
    """Return the parameters of the autopilot of a UAV, which hovers with a thrust.

    An axis' output o changes the thrust of each rotor by o / 2 of the largest, T. So it makes the
    moment 2 s T o of roll and pitch, with the rotors at s from the axes, and 2 k T o of yaw, and a
    gain p of the rate's error makes omega' = p 2 s T / J (command - omega): p = J / (2 s T tau).

    rate_hz: Steps of the physics a second.
    """
    largest_N = rotors.thrust_N[1]
    s = rotors.arm_m / math.sqrt(2.0)
    arms_m = (s, s, rotors.drag_to_thrust_m)
    gains: dict[str, float] = {}
    for axis, name in enumerate(_AXES):
        tau_s = setup.run.settings.rate_time_constant_s[axis]
        p = uav.inertia[axis, axis] / (2.0 * arms_m[axis] * largest_N * tau_s)
        gains[f"ATC_RAT_{name}_P"] = p
        gains[f"ATC_RAT_{name}_I"] = _INTEGRAL[axis] * p
        gains[f"ATC_RAT_{name}_D"] = 0.0
    timeout_s = setup.vehicles.setpoint_timeout_s
    return {
        **_ALWAYS,
        **gains,
        "SIM_RATE_HZ": rate_hz,
        "MOT_THST_HOVER": hover_N / (4.0 * largest_N),
        "GUID_TIMEOUT": timeout_s,
        **setup.vehicles.parameters,
    }
