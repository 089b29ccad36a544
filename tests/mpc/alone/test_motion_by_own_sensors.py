"""The motion of one UAV by its own sensors alone (docs/equations.md (31d), (31e))."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.hover import hover
from transport.model.physics.parameters import table_1
from transport.model.physics.rotations import euler_rates, rotation
from transport.mpc.alone.motion_by_own_sensors import OwnSensors
from transport.mpc.alone.uav_motion import UavMotion, motion_of

SYSTEM = table_1()
AT_REST = hover(SYSTEM)
UAV, PERIOD_S = 1, 0.05
THRUST_N = float(AT_REST.u[state.INPUTS * UAV])
TENSION_N = float(AT_REST.tensions[UAV])
DOWN = np.array([0.0, 0.0, 1.0])
ROUNDING = 1e-9
# Trapezoids and sums of a pendulum over seconds, and the lag of the observer: a tenth of the swing.
OBSERVED = 0.15
# Noise of the specific force in `eight`, m/s^2: a small accelerometer between vibrating rotors.
NOISE_MPS2 = 0.3
# Bound of the speed of the rod's end that this noise makes of a taut rod: 3.5 deg of direction, 0.2 m of
# the rod's end, changes the speed by 0.09 m/s in a period.
NOISE_MPS = 0.5


def own_sensors(ages: Sequence[int] = (0,) * 5) -> OwnSensors:
    """Return the observer of a UAV of the paper's team."""
    return OwnSensors(SYSTEM, UAV, TENSION_N, ages, PERIOD_S)


def measured(rest: UavMotion, pull_I: Array) -> Array:
    """Return the measurements, (15,), of a level UAV at rest whose rod has a force, (3,), N."""
    z = np.zeros(state.SENSED)
    z[state.POSITION] = rest.position_I
    z[state.SPECIFIC_FORCE] = (pull_I - THRUST_N * DOWN) / SYSTEM.uavs[UAV].mass
    return z


def test_the_observer_sees_the_swing() -> None:
    """From the specific force of a resting UAV under a swinging rod, velocity and place of its end are those of it."""
    sensors = own_sensors()
    uav, thrust_N = SYSTEM.uavs[UAV], float(AT_REST.u[4 * UAV])
    rest = motion_of(SYSTEM, UAV, AT_REST.x)
    frequency = np.sqrt(SYSTEM.gravity / uav.rod_length)
    swing_m, errors = 0.3, []
    for k in range(200):
        end_I = np.array([swing_m * np.sin(frequency * k * PERIOD_S), 0.0, 0.0])
        end_I[2] = np.sqrt(uav.rod_length**2 - end_I[0] ** 2)
        z = np.zeros(state.SENSED)
        z[state.POSITION] = rest.position_I
        z[state.SPECIFIC_FORCE] = (7.0 * end_I / uav.rod_length - [0.0, 0.0, thrust_N]) / uav.mass
        sensors.observe(z, thrust_N, k, lambda _: rest)
        motion = sensors.motion(z, k, k, lambda _: rest)
        errors.append(motion.swing_I[0] - swing_m * frequency * np.cos(frequency * k * PERIOD_S))
    assert np.sqrt(np.mean(np.square(errors[60:]))) < np.sqrt(
        0.5
    ) * 2.0 * swing_m * frequency * np.sqrt(OBSERVED)


@pytest.mark.parametrize(
    "pull_N", [0.0, -0.5 * TENSION_N, -TENSION_N], ids=["slack", "pushes", "pushes more"]
)
def test_a_rod_without_tension_shows_no_direction(pull_N: float) -> None:
    """While a payload falls, or its rod pushes, the swing stays at what noise makes of a taut rod.

    The force is then noise, of any direction, or has the direction opposite to the rod's: taken for a
    rod it is metres beside it.
    """
    rng = np.random.default_rng(7)
    sensors = own_sensors()
    rest = motion_of(SYSTEM, UAV, AT_REST.x)
    pulls_N = [TENSION_N] * 60 + [pull_N] * 60 + [TENSION_N] * 60
    for k, tension_N in enumerate(pulls_N):
        noise_N = SYSTEM.uavs[UAV].mass * NOISE_MPS2 * rng.standard_normal(3)
        z = measured(rest, tension_N * DOWN + noise_N)
        sensors.observe(z, THRUST_N, k, lambda _: rest)
        motion = sensors.motion(z, k, k, lambda _: rest)
        assert np.linalg.norm(motion.swing_I - rest.swing_I) < NOISE_MPS


def test_a_rod_with_half_its_tension_is_observed() -> None:
    """A payload that sinks at half of gravity still shows where its rods lean."""
    sensors = own_sensors()
    rest = motion_of(SYSTEM, UAV, AT_REST.x)
    leaning_I = np.array([np.sin(0.2), 0.0, np.cos(0.2)])
    z = measured(rest, 0.5 * TENSION_N * leaning_I)
    for k in range(100):
        sensors.observe(z, THRUST_N, k, lambda _: rest)
    motion = sensors.motion(z, 99, 99, lambda _: rest)
    np.testing.assert_allclose(motion.rod_I, SYSTEM.uavs[UAV].rod_length * leaning_I, atol=1e-3)


def test_the_motion_is_only_read() -> None:
    """However often the motion is asked for, the estimate of the rod is that of the observations."""
    sensors = own_sensors()
    rest = motion_of(SYSTEM, UAV, AT_REST.x)
    z = measured(rest, TENSION_N * np.array([0.3, 0.0, 0.9]))
    sensors.observe(z, THRUST_N, 0, lambda _: rest)
    first, second = (sensors.motion(z, 0, 0, lambda _: rest) for _ in range(2))
    np.testing.assert_array_equal(first.rod_I, second.rod_I)
    np.testing.assert_array_equal(first.swing_I, second.swing_I)


@pytest.mark.parametrize("ages", [(0, 0, 0, 0, 0), (3, 1, 2, 4, 2)])
@pytest.mark.parametrize("ahead", [0, 1])
@pytest.mark.parametrize("k", [2, 10])
def test_late_sensors_show_deviations_that_go_on(ages: tuple[int, ...], ahead: int, k: int) -> None:
    """A UAV that deviates from a moving reference at constant rates is seen where it is, (31e).

    The reference moves, turns and swings at changing rates; before the start there is none.
    """
    sensors = own_sensors(ages)
    rest = motion_of(SYSTEM, UAV, AT_REST.x)
    rng = np.random.default_rng(4)
    drift, turning = rng.normal(0.0, 0.2, (2, 3))
    moving, faster, spinning = rng.normal(0.0, 1.0, (3, 3))

    def reference(tick: int) -> UavMotion:
        assert tick >= 0
        time_s = PERIOD_S * tick
        leaning = rotation(np.array([0.1 * time_s, 0.2 * time_s, 0.0]))
        return UavMotion(
            position_I=rest.position_I + time_s * moving + 0.5 * time_s**2 * faster,
            velocity_I=moving + time_s * faster,
            Theta=0.1 * time_s**2 * spinning,
            omega_B=time_s * spinning,
            rod_I=leaning @ rest.rod_I,
            swing_I=time_s * moving,
        )

    # Each sensor shows the deviation of its time; the rod is that of the reference.
    then = [reference(max(k - age, 0)) for age in ages]
    since_s = [PERIOD_S * (k - age) for age in ages]
    z = np.zeros(state.SENSED)
    z[state.POSITION] = then[0].position_I + since_s[0] * drift
    z[state.VELOCITY] = then[1].velocity_I + drift
    z[state.THETA] = then[2].Theta + since_s[2] * turning
    z[state.OMEGA] = then[3].omega_B + turning
    pull_I = TENSION_N / SYSTEM.uavs[UAV].rod_length * then[4].rod_I
    force_B = rotation(z[state.THETA]).T @ pull_I - THRUST_N * DOWN
    z[state.SPECIFIC_FORCE] = force_B / SYSTEM.uavs[UAV].mass

    sensors.observe(z, THRUST_N, k, reference)
    motion = sensors.motion(z, k, k + ahead, reference)
    there, there_s = reference(k + ahead), PERIOD_S * (k + ahead)
    expected = {
        "position_I": there.position_I + there_s * drift,
        "velocity_I": there.velocity_I + drift,
        "Theta": there.Theta + there_s * turning,
        "omega_B": there.omega_B + turning,
        "rod_I": there.rod_I,
        "swing_I": there.swing_I,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(motion, name), value, atol=ROUNDING, err_msg=name)


def test_dead_reckoning_replaces_missing_measurements() -> None:
    """A UAV that turns and accelerates: position, velocity and attitude follow from the other sensors, (31i).

    Steps are of first order, so half the period halves the error.
    """
    omega_B, force_B = np.array([0.2, -0.1, 0.3]), np.array([0.5, 0.3, -9.0])
    missing = 0b00111
    errors = []
    for steps in (20, 40):
        period_s = 1.0 / steps
        sensors = OwnSensors(SYSTEM, UAV, TENSION_N, (0,) * 5, period_s)
        z = np.zeros(state.SENSED)
        z[state.OMEGA], z[state.SPECIFIC_FORCE] = omega_B, force_B
        sensors.completed(z, 0, 0)
        for k in range(1, steps + 1):
            reckoned = sensors.completed(z, missing, k)

        # The motion that was, by steps a hundred times shorter.
        r, v, Theta = np.zeros(3), np.zeros(3), np.zeros(3)
        for _ in range(2000):
            a = rotation(Theta) @ force_B + SYSTEM.gravity * DOWN
            r, v, Theta = r + v / 2000, v + a / 2000, Theta + euler_rates(Theta) @ omega_B / 2000
        errors.append(np.abs(reckoned[:9] - np.concatenate([r, v, Theta])).max())
        np.testing.assert_array_equal(reckoned[9:], z[9:])
    assert errors[0] < 0.1
    assert errors[1] == pytest.approx(errors[0] / 2.0, rel=0.15)


def test_known_drag_is_no_force_of_the_rod() -> None:
    """A UAV tilted at 5 m/s through still air: what its accelerometer shows of known drag is no pull, (31d)."""
    drag = 0.3, 0.5
    uavs = tuple(replace(uav, drag=np.array(drag)) for uav in SYSTEM.uavs)
    sensors = OwnSensors(replace(SYSTEM, uavs=uavs), UAV, TENSION_N, (0,) * 5, PERIOD_S)
    rest = motion_of(SYSTEM, UAV, AT_REST.x)
    Theta, v_I = np.array([0.1, -0.3, 0.2]), np.array([4.0, 3.0, -0.5])
    R = rotation(Theta)
    v_B = R.T @ v_I
    drag_I = -R @ (np.array([drag[0], drag[0], drag[1]]) * v_B)

    z = np.zeros(state.SENSED)
    z[state.POSITION] = rest.position_I
    z[state.VELOCITY] = v_I
    z[state.THETA] = Theta
    specific_N = R.T @ (TENSION_N * DOWN + drag_I) - THRUST_N * DOWN
    z[state.SPECIFIC_FORCE] = specific_N / SYSTEM.uavs[UAV].mass
    for k in range(100):
        sensors.observe(z, THRUST_N, k, lambda _: rest)
    motion = sensors.motion(z, 99, 99, lambda _: rest)
    np.testing.assert_allclose(motion.rod_I, rest.rod_I, atol=ROUNDING)
