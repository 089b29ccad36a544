"""Unmodelled effects: masses, wind, noise, each a function of scenario and tick only."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from tests.support.runs import setup
from transport.flight.roles import plant_run
from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.rotations import rotation
from transport.model.state import StateView
from transport.plant.wind_and_noise import Environment
from transport.protocol.scenario.setup.run_setup import Setup

MEAN = "plant.wind.speed_mps=[3.0,-1.0,0.5]"
GUSTS = "plant.wind.gust_mps=[2.0,1.0,0.5]"
LEVELS = {
    "position_m": 0.01,
    "velocity_mps": 0.02,
    "attitude_rad": 0.003,
    "rate_rads": 0.004,
    "rod_direction_rad": 0.005,
    "rod_rate_rads": 0.006,
}
NOISE = tuple(f"plant.noise.{key}={level}" for key, level in LEVELS.items())

DRAG = (
    "system.payload.drag_kgps=0.6",
    *(f"system.uav.{i}.drag_kgps=[0.3,0.1]" for i in (1, 2, 3, 4)),
)

# Standard deviations of thousands of normal numbers, of which some hang together.
STATISTICS = 0.1
ROUNDING = 1e-12


def state_in_motion(run: Setup) -> Array:
    """Return the initial state with every velocity and rate of some size and e . Omega = 0."""
    x = run.initial_state() + 0.1 * np.random.default_rng(3).standard_normal(run.system.n)
    view = StateView(x)
    view.e_P[:] /= np.linalg.norm(view.e_P, axis=1, keepdims=True)
    view.Omega_P[:] -= view.e_P * (view.e_P * view.Omega_P).sum(axis=1, keepdims=True)
    return x


def test_by_default_the_truth_is_what_the_controller_knows() -> None:
    """By default there are no forces, the nominal model, and exact measurements, bit for bit."""
    run = setup()
    environment = Environment(plant_run(run))
    x = state_in_motion(run)
    assert environment.model is run.model
    assert environment.forces(7, x) is None
    assert environment.measured(7, 1, x) is x


@pytest.mark.parametrize(("payload", "uavs"), [(1.15, 1.0), (1.0, 0.9), (2.0, 3.0)])
def test_masses(payload: float, uavs: float) -> None:
    """Only mass and inertia of payload and UAVs are multiplied, and only in the plant."""
    run = setup(f"plant.payload_mass_factor={payload}", f"plant.uav_mass_factor={uavs}")
    true, known = Environment(plant_run(run)).model.system, run.system
    assert known.payload.mass == 3.0
    assert true.payload.mass == payload * known.payload.mass
    np.testing.assert_array_equal(true.payload.inertia, payload * known.payload.inertia)
    for found, uav in zip(true.uavs, known.uavs, strict=True):
        assert (found.mass, found.rod_length) == (uavs * uav.mass, uav.rod_length)
        np.testing.assert_array_equal(found.inertia, uavs * uav.inertia)
        np.testing.assert_array_equal(found.rho, uav.rho)
    assert true.gravity == known.gravity


@pytest.mark.parametrize(
    "settings",
    [
        ("plant.uav=[{id=2,mass_factor=1.5}]",),
        ("plant.payload_centre_m=[0.05,0.0,0.0]",),
        ("plant.payload_inertia_factor=1.5",),
        (*DRAG, "plant.drag_factor=0.5"),
    ],
)
def test_the_equations_are_those_of_the_actual_bodies(settings: tuple[str, ...]) -> None:
    """From the start, without a UAV that is released, and with another load."""
    run = setup(*settings)
    environment = Environment(plant_run(run))
    x, u = state_in_motion(run), 1.1 * run.hover.u
    known = [run.model.derivative(x, u)]
    for change in ("none", "release", "load"):
        if change == "release":
            environment.release(1)
        if change == "load":
            environment.load(replace(environment.system.payload, mass=5.0))
        found = environment.model.derivative(x, u)
        np.testing.assert_array_equal(found, Model(environment.system).derivative(x, u))
        assert all(np.abs(found - before).max() > 1e-6 for before in known)
        known.append(found)


def test_drag_is_that_of_the_air_past_each_body() -> None:
    """F_j = c_j (W - velocity), docs/equations.md (42): zero on any body that moves with the air."""
    run = setup(MEAN, "plant.wind.drag_payload_kgps=0.7", "plant.wind.drag_uav_kgps=0.3")
    environment = Environment(plant_run(run))
    wind = np.array([3.0, -1.0, 0.5])
    at_rest = environment.forces(0, run.initial_state())
    assert at_rest is not None
    assert (
        np.abs(at_rest.reshape(5, 3) - np.outer([0.7, 0.3, 0.3, 0.3, 0.3], wind)).max() < ROUNDING
    )
    drifting = run.initial_state()
    drifting[state.V0] = wind  # level: payload frame and inertial frame agree
    carried = environment.forces(0, drifting)
    assert carried is not None
    assert np.abs(carried).max() < ROUNDING
    x = state_in_motion(run)
    moving = environment.forces(0, x)
    assert moving is not None
    positions = run.model.outputs(
        x + 1e-6 * run.model.derivative(x, run.hover.u)
    ) - run.model.outputs(x)
    velocity = positions[:3] / 1e-6  # of the first UAV
    assert np.abs(moving[3:6] - 0.3 * (wind - velocity)).max() < 1e-5


def test_drag_of_the_bodies_needs_no_wind() -> None:
    """Coefficients of `[system]` act in still air, times the plant's factor, whether known or not.

    The force on a body is -D v in still air and zero where it moves with the air, (42).
    """
    for factor, knows in ((1.0, "true"), (0.5, "true"), (1.5, "false")):
        run = setup(*DRAG, f"plant.drag_factor={factor}", f"controller.knows_drag={knows}")
        environment = Environment(plant_run(run))
        assert environment.forces(0, state_in_motion(run)) is None, (
            "a part of the engine's equations"
        )
        assert environment.system.payload.drag == 0.6 * factor
        np.testing.assert_allclose(environment.system.uavs[3].drag, [0.3 * factor, 0.1 * factor])
        known = 0.6 if knows == "true" else 0.0
        assert run.system.payload.drag == known


def test_wind_carries_the_bodies_along() -> None:
    """A body that moves with the air feels no force: that of the wind is the drag against it, (42)."""
    run = setup(*DRAG, MEAN)
    environment = Environment(plant_run(run))
    x = state_in_motion(run)
    in_wind = environment.forces(0, x)
    assert in_wind is not None
    still = environment.model.derivative(x, run.hover.u, forces=in_wind)

    # All velocities less the wind, in air at rest: the same accelerations.
    view = StateView(x.copy())
    view.v0_P[:] -= rotation(view.Theta0).T @ np.array([3.0, -1.0, 0.5])
    carried = environment.model.derivative(view.x, run.hover.u)
    np.testing.assert_allclose(still[state.OMEGA0], carried[state.OMEGA0], atol=1e-9)
    # a_0 = v_0' + omega_0 x v_0 is the acceleration, in both.
    turning = np.cross(view.omega0_P, StateView(x).v0_P), np.cross(view.omega0_P, view.v0_P)
    np.testing.assert_allclose(
        still[state.V0] + turning[0], carried[state.V0] + turning[1], atol=1e-9
    )


def test_drag_without_coefficients() -> None:
    """Bodies without coefficients have drag in wind by default, in still air only if it is given."""
    x = state_in_motion(setup())
    assert Environment(plant_run(setup())).forces(0, x) is None
    given = Environment(plant_run(setup("plant.wind.drag_uav_kgps=0.3"))).forces(0, x)
    assert given is not None
    velocities = setup().model.velocities(x)
    np.testing.assert_allclose(given.reshape(5, 3)[1:], -0.3 * velocities[1:], atol=ROUNDING)
    assert not given[:3].any()
    breeze = Environment(plant_run(setup("plant.wind.speed_mps=[1e-9,0,0]"))).forces(0, x)
    assert breeze is not None
    np.testing.assert_allclose(breeze[:3], -0.4 * velocities[0], atol=1e-8)
    np.testing.assert_allclose(breeze.reshape(5, 3)[1:], -0.2 * velocities[1:], atol=1e-8)
    # Controllers know coefficients, the plant has none of them.
    without = Environment(plant_run(setup(*DRAG, MEAN, "plant.drag_factor=0.0"))).forces(0, x)
    assert without is not None
    assert not without.any()


def test_gusts_push_at_the_actual_centre_of_mass() -> None:
    """Wind of gusts alone, at its tick, past the centre of mass of a payload that turns."""
    centre = "plant.payload_centre_m=[0.3,-0.2,0.1]"
    run = setup(GUSTS, centre)
    environment = Environment(plant_run(run))
    x = state_in_motion(run)
    forces = environment.forces(7, x)
    assert forces is not None
    view = StateView(x)
    v_P = view.v0_P + np.cross(view.omega0_P, [0.3, -0.2, 0.1])
    expected = 0.4 * (environment.wind(7) - rotation(view.Theta0) @ v_P)
    np.testing.assert_allclose(forces[:3], expected, atol=ROUNDING)


def test_random_numbers_are_those_of_seed_tick_and_agent() -> None:
    """Whatever was asked before; each differs in all numbers, but the wind is the same for all agents."""
    rows = {}
    for seed in (1, 2):
        run = setup(GUSTS, *NOISE, f"seed={seed}")
        x = state_in_motion(run)
        for tick, agent in ((5, 1), (3, 1), (5, 2)):
            environment = Environment(plant_run(run))
            error = environment.measured(tick, agent, x) - x
            rows[seed, tick, agent] = np.array([environment.wind(tick), error[:3], error[3:6]])
        again = environment.measured(3, 1, x) - x, environment.wind(3)
        np.testing.assert_array_equal(rows[seed, 3, 1], [again[1], again[0][:3], again[0][3:6]])
        np.testing.assert_array_equal(rows[seed, 5, 1][0], rows[seed, 5, 2][0])
    for one, other in combinations(rows, 2):
        same = rows[one] == rows[other]
        assert not same[0 if one[:2] != other[:2] else 1 :].any(), (one, other)


def test_gusts_are_a_gauss_markov_process() -> None:
    """Mean, standard deviation and correlation of (43) over time, here 4 ticks long."""
    environment = Environment(plant_run(setup(MEAN, GUSTS, "plant.wind.gust_time_constant_s=0.2")))
    W = np.array([environment.wind(k) for k in range(6000)])
    scaled = (W - np.array([3.0, -1.0, 0.5])) / np.array([2.0, 1.0, 0.5])
    assert np.abs(scaled.mean(axis=0)).max() < STATISTICS
    assert np.abs(scaled.std(axis=0) - 1.0).max() < STATISTICS
    for ticks in (1, 4, 40):
        correlation = (scaled[:-ticks] * scaled[ticks:]).mean(axis=0)
        assert np.abs(correlation - np.exp(-0.05 * ticks / 0.2)).max() < STATISTICS
    assert np.abs(np.corrcoef(scaled.T) - np.eye(3)).max() < STATISTICS
    # A new one each 50 ms: none lies between its neighbours.
    bends = (scaled[2:] - 2.0 * scaled[1:-1] + scaled[:-2]).std(axis=1)
    assert abs(bends[::2].mean() / bends[1::2].mean() - 1.0) < STATISTICS


@pytest.mark.parametrize("period_s", [0.1, 0.025, 0.02, 0.0125, 0.012, 0.01])
def test_the_same_wind_at_any_rate(period_s: float) -> None:
    """Gusts are a function of seed and time, linear between the same values at any sampling period."""
    usual = Environment(plant_run(setup(MEAN, GUSTS)))
    every_50_ms = np.array([usual.wind(k) for k in range(41)])
    other = Environment(plant_run(setup(MEAN, GUSTS, f"controller.sampling_period_s={period_s}")))
    times_s = period_s * np.arange(int(2.0 / period_s) + 1)
    found = np.array([other.wind(k) for k in range(len(times_s))])
    expected = [np.interp(times_s, 0.05 * np.arange(41), every_50_ms[:, axis]) for axis in range(3)]
    np.testing.assert_allclose(found, np.transpose(expected), rtol=0.0, atol=1e-12)


def test_noise_has_the_standard_deviations_asked_for() -> None:
    """Each kind of measurement errs by its own level, independently for every axis and agent."""
    run = setup(*NOISE)
    environment = Environment(plant_run(run))
    x = state_in_motion(run)
    seen = np.array([environment.measured(k, agent, x) for k in range(400) for agent in (1, 2)])
    error, true = StateView(seen - x), StateView(x)
    levels = LEVELS
    for found, level in (
        (error.r0_I, levels["position_m"]),
        (error.v0_P, levels["velocity_mps"]),
        (error.Theta0, levels["attitude_rad"]),
        (error.omega0_P, levels["rate_rads"]),
        (error.Theta, levels["attitude_rad"]),
        (error.omega_B, levels["rate_rads"]),
    ):
        assert np.abs(found.std(axis=0) / level - 1.0).max() < STATISTICS
    # A rod's direction and rate only err across the rod: two of three axes.
    for vectors, level in (
        (error.e_P, levels["rod_direction_rad"]),
        (error.Omega_P, levels["rod_rate_rads"]),
    ):
        across = vectors - true.e_P * (true.e_P * vectors).sum(axis=-1, keepdims=True)
        assert (
            np.abs(np.sqrt((across**2).sum(axis=-1).mean(axis=0) / 2.0) / level - 1.0).max()
            < STATISTICS
        )


def test_noisy_rods_are_rods() -> None:
    """|e| = 1 and e . Omega = 0 hold in every measurement."""
    run = setup(*NOISE)
    environment = Environment(plant_run(run))
    view = StateView(
        np.array([environment.measured(k, 1, state_in_motion(run)) for k in range(50)])
    )
    assert np.abs(np.linalg.norm(view.e_P, axis=-1) - 1.0).max() < ROUNDING
    assert np.abs((view.e_P * view.Omega_P).sum(axis=-1)).max() < ROUNDING
