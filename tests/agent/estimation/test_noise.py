"""Noise that the filter assumes: its order and its units."""

from dataclasses import replace

import numpy as np

from tests.support.random_systems import random_system
from transport.agent.estimation.filter.assumed_noise import (
    FirstErrors,
    ForceNoise,
    LeastSensorNoise,
    ModelNoise,
)
from transport.agent.estimation.filter.manifold import Manifold
from transport.agent.estimation.filter.unknown_forces import (
    COUNT,
    DRAG,
    MASS_ERROR,
    PAYLOAD_FORCE,
    UAV_FORCE,
)
from transport.model.arrays import Array
from transport.model.physics.hover import hover
from transport.model.physics.parameters import table_1
from transport.model.state import StateView
from transport.protocol.scenario.setup.team_run import SensorSheet

PERIOD_S = 0.05
UNEQUAL = random_system(np.random.default_rng(5), 3)
NOISE = ForceNoise()


def by_state(deviations: Array) -> StateView:
    """Return deviations of the states at hover by those of the coordinates, (62)."""
    system = table_1()
    T = Manifold(system.N).basis(hover(system).x).T
    return StateView(np.sqrt(T**2 @ deviations**2))


def test_first_errors_belong_to_their_states() -> None:
    """The coordinates of each state, two of rods and three of the others, have its error, (62)."""
    errors = FirstErrors()
    found = by_state(errors.by_coordinate(table_1().N))
    tilts_and_yaw = [*[errors.payload_tilt_rad] * 2, errors.payload_yaw_rad]
    rates = [*[errors.payload_rate_rads] * 2, errors.payload_yaw_rate_rads]
    np.testing.assert_array_equal(found.r0_I, errors.payload_position_m)
    np.testing.assert_array_equal(found.v0_P, errors.payload_velocity_mps)
    np.testing.assert_array_equal(found.Theta0, tilts_and_yaw)
    np.testing.assert_array_equal(found.omega0_P, rates)
    np.testing.assert_array_equal(found.e_P[:, :2], errors.rod_rad)
    np.testing.assert_array_equal(found.Omega_P[:, :2], errors.rod_rate_rads)
    np.testing.assert_array_equal(found.Theta, errors.uav_attitude_rad)
    np.testing.assert_array_equal(found.omega_B, errors.uav_rate_rads)


def test_first_errors_and_correlation_are_those_documented() -> None:
    """0.3 m and 3.4 deg of the payload, in yaw 0.9 deg and 1.1 deg/s, (64); one air by 0.8, (63a)."""
    errors = FirstErrors()
    assert errors.payload_position_m == 0.3
    in_deg = np.degrees(
        [errors.payload_tilt_rad, errors.payload_yaw_rad, errors.payload_yaw_rate_rads]
    )
    np.testing.assert_array_equal(np.round(in_deg, 1), [3.4, 0.9, 1.1])
    assert ForceNoise().same_air == 0.8


def test_accelerations_change_velocities_and_rates_alone() -> None:
    """White accelerations over a period add their square times the period's to these, (63)."""
    acceleration = 0.3
    variances = ModelNoise().acceleration_variances(acceleration, PERIOD_S, table_1().N)
    found = by_state(np.sqrt(variances))
    for places in (found.r0_I, found.Theta0, found.e_P, found.Theta):
        assert not places.any()
    for rates in (found.v0_P, found.omega0_P, found.Omega_P[:, :2], found.omega_B):
        np.testing.assert_allclose(rates, acceleration * PERIOD_S)


def test_bias_of_sensors_counts_as_noise() -> None:
    """Each axis has the sum of both variances, and no less noise than is assumed, after (64)."""
    least = LeastSensorNoise()
    noise, bias = np.array([3.0, 4.0, 5.0, 6.0, 0.0]), np.array([4.0, 3.0, 12.0, 8.0, 0.0])
    sheet = SensorSheet(vehicle=True, noise=noise, bias=bias, ages=(0,) * 5)
    expected = [5.0, 5.0, 13.0, 10.0, least.specific_force_mps2]
    found = np.sqrt(least.variances(sheet)).reshape(5, 3)
    np.testing.assert_allclose(found, np.repeat(expected, 3).reshape(5, 3))


def test_exact_sensors_are_assumed_to_err() -> None:
    """By 1 mm, 5 mm/s, 1 mrad, 2 mrad/s and 0.1 m/s^2, each on three axes."""
    sheet = SensorSheet(vehicle=True, noise=np.zeros(5), bias=np.zeros(5), ages=(0,) * 5)
    expected = np.repeat([1e-3, 5e-3, 1e-3, 2e-3, 0.1], 3)
    np.testing.assert_allclose(np.sqrt(LeastSensorNoise().variances(sheet)), expected)


def test_units_of_unknown_forces() -> None:
    """Forces are shares of a weight in N, the mass error of the payload's mass in kg, (63a).

    Drag is a share of a mass per second. Of the UAVs the lightest counts.
    """
    payload_kg, uav_kg = UNEQUAL.payload.mass, min(uav.mass for uav in UNEQUAL.uavs)
    expected = np.zeros(COUNT)
    expected[PAYLOAD_FORCE] = 0.03 * payload_kg * UNEQUAL.gravity
    expected[MASS_ERROR] = 0.2 * payload_kg
    expected[UAV_FORCE] = 0.03 * uav_kg * UNEQUAL.gravity
    for noise, uav_drag in ((ForceNoise(), 0.3), (ForceNoise(uav_drag=NOISE.payload_mass), 0.2)):
        expected[DRAG] = 0.3 * payload_kg, uav_drag * uav_kg
        np.testing.assert_allclose(noise.first(UNEQUAL), expected)


def test_unknown_forces_are_random_walks() -> None:
    """Variances grow at a constant rate; one air moves payload and UAVs alike, (63)."""
    change, steps = NOISE.change(UNEQUAL, PERIOD_S), round(1.0 / PERIOD_S)
    deviations = np.sqrt(np.diag(steps * change))
    light = NOISE.change(replace(UNEQUAL, gravity=0.0), PERIOD_S)
    no_force = [MASS_ERROR, *range(DRAG.start, DRAG.stop)]
    np.testing.assert_array_equal(np.flatnonzero(np.diag(light)), no_force)
    payload_kg, uav_kg = UNEQUAL.payload.mass, min(uav.mass for uav in UNEQUAL.uavs)
    over_a_second = np.zeros(COUNT)
    over_a_second[PAYLOAD_FORCE] = 0.045 * payload_kg * UNEQUAL.gravity
    over_a_second[MASS_ERROR] = 0.015 * payload_kg
    over_a_second[UAV_FORCE] = 0.036 * uav_kg * UNEQUAL.gravity
    over_a_second[DRAG] = 0.015 * payload_kg, 0.015 * uav_kg
    np.testing.assert_allclose(deviations, over_a_second)

    correlations = steps * change / np.outer(deviations, deviations)
    expected = np.eye(COUNT)
    for payload, uavs in ((0, 3), (1, 4)):
        expected[[payload, uavs], [uavs, payload]] = NOISE.same_air
    np.testing.assert_allclose(correlations, expected)
