"""Lag of the motors: held inputs of order 4 against an ODE solver, and the expansion of motion and motors."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from tests.support.random_systems import random_forces, random_input, random_state, random_system
from transport.model.arrays import Array
from transport.model.linear.discretisation import by_exponential, zero_order_hold
from transport.model.linear.linearisation import Model
from transport.model.linear.motor_lag import Period, decay, integrate, with_lag
from transport.model.physics.parameters import table_1
from transport.model.state import StateView

PERIOD_S = 0.05
LAGS_S = (0.005, 0.03, 0.1)
# Deviation of the commands from the actual inputs at the beginning, N and N m: a tenth of the range
# of the inputs.
JUMP = np.tile([4.5, 0.2, 0.2, 0.1], 4)

# Relative to the largest entry; rounding of a series of some twenty terms.
ROUNDING = 1e-12
# Plant: five steps per period. Agents: two. After the jump above, SI.
PLANT_ERROR, AGENT_ERROR = 1e-6, 2e-5


@lru_cache
def case(*, rates: bool = False) -> tuple[Model, Array, Array, Array, Array]:
    """Return a model, a moving state, actual inputs, commands that differ from them, and forces."""
    rng = np.random.default_rng(4)
    system = replace(table_1(), rate_gains=np.array([25.0, 20.0, 10.0]) if rates else None)
    x, a = random_state(rng, system.N, rate=0.5), random_input(rng, system.N)
    return (
        Model(system),
        x,
        a,
        a + JUMP * rng.uniform(-1.0, 1.0, len(a)),
        random_forces(rng, system.N),
    )


def reference(lag_s: float, *, rates: bool = False) -> Array:
    """Return state and actual inputs after a period by the augmented ODE x' = f(x, a), a' = (u - a) / lag.

    Of commanded body rates a' has omega' beside that: (58a).
    """
    model, x, a, u, forces = case(rates=rates)
    n = len(x)

    def slope(_: float, z: Array) -> Array:
        moving = model.derivative(z[:n], z[n:], forces=forces)
        changing = (u - z[n:]) / lag_s
        if rates:
            changing.reshape(-1, 4)[:, 1:] += StateView(moving).omega_B
        return np.concatenate([moving, changing])

    start = np.concatenate([x, a])
    found = solve_ivp(
        slope, (0.0, PERIOD_S), start, method="DOP853", rtol=1e-12, atol=1e-13, max_step=lag_s / 2.0
    )
    return np.asarray(found.y[:, -1])


def error(lag_s: float, steps: int, *, rates: bool = False) -> float:
    """Return the largest difference from the ODE solver after a period."""
    model, x, a, u, forces = case(rates=rates)
    period = Period(duration_s=PERIOD_S, steps=steps, lag_s=lag_s)
    found = integrate(model, np.concatenate([x, a]), u, period, forces)
    return float(np.abs(found - reference(lag_s, rates=rates)).max())


@pytest.mark.parametrize("rates", [False, True], ids=["moments", "body rates"])
@pytest.mark.parametrize("lag_s", LAGS_S[1:])
def test_order_four(lag_s: float, *, rates: bool) -> None:
    """Halving the step divides the error by 16, docs/equations.md (54), (58a)."""
    errors = [error(lag_s, steps, rates=rates) for steps in (2, 4, 8)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (np.abs(orders - 4.0) < 0.5).all(), orders


@pytest.mark.parametrize("lag_s", LAGS_S)
def test_accuracy(lag_s: float) -> None:
    """Plant and agents follow the augmented ODE closely also where the lag is shorter than a step, (53), (54)."""
    assert error(lag_s, 5) < PLANT_ERROR
    assert error(lag_s, 2) < AGENT_ERROR


def test_without_lag_the_command_acts() -> None:
    """With lag 0 the integration is that of the held command, bit for bit."""
    model, x, _, u, forces = case()
    found = integrate(model, x, u, Period(duration_s=PERIOD_S, steps=2), forces)
    expected, _ = model.integrate(x, u, PERIOD_S, 2, forces=forces)
    np.testing.assert_array_equal(found, expected)
    assert decay(0.0, PERIOD_S) == 0.0


@pytest.mark.parametrize("hold", [zero_order_hold, by_exponential])
@pytest.mark.parametrize("lag_s", [5e-4, *LAGS_S])
def test_expansion_of_motion_and_motors(lag_s: float, hold: object) -> None:
    """The factors of the augmented system multiply out to (55), and its hold is the matrix exponential's."""
    rng = np.random.default_rng(8)
    system = random_system(rng, 3)
    model = Model(system, off=[1])
    x, a = random_state(rng, system.N, rate=0.5), random_input(rng, system.N)
    u, (n, m) = a + rng.standard_normal(len(a)), (system.n, system.m)
    plain = model.linearise(x, a)
    found = with_lag(plain, a, u, lag_s)
    A_c = np.block([[plain.A_c, plain.B_c], [np.zeros((m, n)), -np.eye(m) / lag_s]])
    B_c = np.vstack([np.zeros((n, m)), np.eye(m) / lag_s])
    np.testing.assert_array_equal(found.A_c, A_c)
    np.testing.assert_array_equal(found.B_c, B_c)
    np.testing.assert_array_equal(found.C, np.hstack([plain.C, np.zeros((len(plain.C), m))]))
    np.testing.assert_array_equal(found.f, np.concatenate([plain.f, (u - a) / lag_s]))
    np.testing.assert_array_equal(found.y, plain.y)
    whole = np.zeros((n + 2 * m + 1, n + 2 * m + 1))
    whole[: n + m] = np.hstack([A_c, B_c, found.f[:, None]])
    expected = expm(PERIOD_S * whole)[: n + m]
    discrete = hold(found, PERIOD_S)  # type: ignore[operator]
    for got, columns in (
        (discrete.A, slice(0, n + m)),
        (discrete.B, slice(n + m, n + 2 * m)),
        (discrete.f_d, n + 2 * m),
    ):
        scale = max(1.0, float(np.abs(expected[:, columns]).max()))
        np.testing.assert_allclose(got, expected[:, columns], rtol=0.0, atol=ROUNDING * scale)
