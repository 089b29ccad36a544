"""Commanded body rates: the model with an inner loop, and the inner loop of the plant."""

import numpy as np
import pytest
from scipy.linalg import expm

from tests.support.random_systems import random_input, random_state, random_system
from transport.model import state
from transport.model.linear import motor_lag as motors
from transport.model.linear.linearisation import Model
from transport.model.linear.motor_lag import rate_places
from transport.model.physics.parameters import System
from transport.model.state import StateView, uav_slice
from transport.mpc.alone.fail_safe import FailSafe
from transport.plant.inner_loops import INNER_STEP_S, RateLoop

GAINS = np.array([25.0, 20.0, 10.0])
WIDE_NM = np.full(3, np.inf)
# Accelerations of a hundred rad/s^2, and rounding of a solved 3 x 3 system.
ROUNDING = 1e-9
# Central differences of step 1e-6 of smooth functions.
DIFFERENCES = 1e-5
# Ten held inputs of order 4 in a period instead of the exact ones, rad/s.
HALVES = 1e-4


def with_rates(system: System) -> System:
    """Return a system whose inputs are body rates."""
    return System(
        payload=system.payload, uavs=system.uavs, gravity=system.gravity, rate_gains=GAINS
    )


@pytest.mark.parametrize("N", [1, 3])
def test_the_model_is_that_of_moments_with_the_inner_loop(N: int) -> None:
    """The derivative under body rates is that under the moments of the inner loop, (57).

    So are the tensions.
    """
    rng = np.random.default_rng(N)
    system, x, u = random_system(rng, N), random_state(rng, N), random_input(rng, N)
    inputs = RateLoop(with_rates(system), WIDE_NM).moments(u.reshape(N, 4), x).reshape(-1)
    rates, moments = Model(with_rates(system)), Model(system)
    assert np.abs(rates.derivative(x, u) - moments.derivative(x, inputs)).max() < ROUNDING
    assert np.abs(rates.tensions(x, u) - moments.tensions(x, inputs)).max() < ROUNDING


def test_the_derivatives_of_the_model() -> None:
    """B_c along the inputs and the columns of A_c along body rates are those of finite differences."""
    rng, step = np.random.default_rng(5), 1e-6
    model, x, u = (
        Model(with_rates(random_system(rng, 2))),
        random_state(rng, 2),
        random_input(rng, 2),
    )
    linear = model.linearise(x, u)
    for i in range(8):
        du = step * np.eye(8)[i]
        slope = (model.derivative(x, u + du) - model.derivative(x, u - du)) / (2.0 * step)
        assert np.abs(slope - linear.B_c[:, i]).max() < DIFFERENCES
    for i in range(state.PAYLOAD + 9, state.PAYLOAD + 12):
        dx = step * np.eye(len(x))[i]
        slope = (model.derivative(x + dx, u) - model.derivative(x - dx, u)) / (2.0 * step)
        assert np.abs(slope - linear.A_c[:, i]).max() < DIFFERENCES


def test_the_plant_approaches_the_model() -> None:
    """Moments held for a step differ from the continuous inner loop in proportion to the step."""
    rng = np.random.default_rng(7)
    system, x = random_system(rng, 2), random_state(rng, 2, rate=0.2)
    u = random_input(rng, 2)
    loop, moments = RateLoop(with_rates(system), WIDE_NM), Model(system)
    exact, _ = Model(with_rates(system)).integrate(x, u, 0.05, 20)
    errors = []
    for step_s in (INNER_STEP_S, INNER_STEP_S / 2.0):
        found = x
        for _ in range(round(0.05 / step_s)):
            held = loop.moments(u.reshape(2, 4), found).reshape(-1)
            found, _ = moments.integrate(found, held, step_s, 1)
        errors.append(np.abs(StateView(found - exact).omega_B).max())
    assert errors[0] < 0.02 * np.abs(StateView(exact - x).omega_B).max()
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


def test_moments_are_limited() -> None:
    """The inner loop asks for no larger moments than the UAVs have, and leaves the thrust as it is."""
    rng = np.random.default_rng(3)
    system, limits_Nm = with_rates(random_system(rng, 2)), np.array([0.2, 0.3, 0.1])
    command = np.array([[20.0, 9.0, -9.0, 9.0], [15.0, 0.0, 0.0, 0.0]])
    x = random_state(rng, 2, rate=0.0)
    x[StateView(np.arange(float(len(x)))).omega_B.astype(int)] = 0.0
    inputs = RateLoop(system, limits_Nm).moments(command, x)
    assert inputs.tolist() == [[20.0, 0.2, -0.3, 0.1], [15.0, 0.0, 0.0, 0.0]]


def test_the_fail_safe_levels_a_uav() -> None:
    """Roll and pitch of a UAV on its inner loop decay without oscillation under the fail-safe, (58)."""
    system = with_rates(random_system(np.random.default_rng(2), 1))
    gain = FailSafe(system, np.array([9.0, 0.0, 0.0, 0.0])).gain(0)[:, uav_slice(0)]
    for axis in (0, 1):
        attitude = np.array([[0.0, 1.0], [GAINS[axis] * gain[1 + axis, 6 + axis], -GAINS[axis]]])
        modes = np.linalg.eigvals(attitude)
        assert modes.real.max() < -4.0
        assert np.abs(modes.imag).max() < 1e-6
    assert not gain[:, 9:].any()
    assert not gain[3].any()


@pytest.mark.parametrize("lag_s", [0.01, 0.04, 0.1])
def test_a_known_lag_is_inside_the_inner_loop(lag_s: float) -> None:
    """Body rates and actual inputs of the model are those of inner loops whose moments follow with the lag, (58a)."""
    rng = np.random.default_rng(1)
    system, period_s, N = with_rates(random_system(rng, 2)), 0.05, 2
    x, u = random_state(rng, N, rate=0.02), random_input(rng, N)
    a = u + 0.3 * rng.standard_normal(4 * N)
    period = motors.Period(duration_s=period_s, steps=5, lag_s=lag_s)
    found = motors.integrate(Model(system), np.concatenate([x, a]), u, period)
    omega, alpha = StateView(x).omega_B, GAINS * (a.reshape(N, 4)[:, 1:] - StateView(x).omega_B)
    for i, axis in np.ndindex(N, 3):
        K, command = GAINS[axis], u[4 * i + 1 + axis]
        M = np.array([[0.0, 1.0], [-K / lag_s, -1.0 / lag_s]])  # of omega - command and alpha
        rate, turning = expm(M * period_s) @ [omega[i, axis] - command, alpha[i, axis]]
        assert StateView(found[: len(x)]).omega_B[i, axis] == pytest.approx(
            rate + command, abs=HALVES
        )
        assert found[len(x) + 4 * i + 1 + axis] == pytest.approx(
            rate + command + turning / K, abs=HALVES
        )


def test_the_expansion_with_a_known_lag() -> None:
    """The factors multiply out to the derivatives of motion and actual inputs, (58a)."""
    rng, lag_s = np.random.default_rng(4), 0.06
    system = with_rates(random_system(rng, 2))
    model, x, a, u = Model(system), random_state(rng, 2), random_input(rng, 2), random_input(rng, 2)
    plain = model.linearise(x, a)
    found, (n, m) = motors.with_lag(plain, a, u, lag_s, rates=True), (system.n, system.m)
    inputs, states = rate_places(m)
    below = np.hstack([np.zeros((m, n)), -np.eye(m) / lag_s])
    below[inputs] += np.hstack([plain.A_c, plain.B_c])[states]
    assert (
        np.abs(found.A_c - np.vstack([np.hstack([plain.A_c, plain.B_c]), below])).max() < ROUNDING
    )
    assert (
        np.abs(found.f[n:][inputs] - ((u - a) / lag_s)[inputs] - plain.f[states]).max() < ROUNDING
    )
    assert (found.f[n::4] == ((u - a) / lag_s)[::4]).all()
