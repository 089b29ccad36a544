"""The integrator: reference trajectories, order, and what its error estimate is worth."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.support import reference
from tests.support.paper_form import attitude
from tests.support.random_systems import random_forces, random_input, random_state, random_system
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.parameters import System
from transport.model.state import StateView

# Absolute, in the units of each state. The stored samples are good to 1.6e-9, our steps to 1e-9 on
# the fastest motion.
TRAJECTORY_TOLERANCE = 1e-6
HELD_THRUST = [
    name for name in reference.TRAJECTORIES if reference.trajectory(name).force_I is None
]

# Relative and absolute tolerance of the eighth-order integration that stands for the exact
# solution.
EXACT = 1e-13
NOMINAL_ORDER = 5
ORDER_SLACK = 0.9  # the next orders, 4 and 6, stay outside
SHORT_STEP_S = 0.0125
# One call of several steps against as many calls: the same operations, compiled in another order.
SAME_ROUNDING = 1e-13


def exact(
    model: Model, x: Array, u: Array, duration_s: float, forces: Array | None = None
) -> Array:
    """Solution by SciPy's DOP853, an integrator and a step control that are not ours."""

    def derivative(_: float, y: Array) -> Array:
        return model.derivative(y, u, forces=forces)

    solution = solve_ivp(derivative, (0.0, duration_s), x, method="DOP853", rtol=EXACT, atol=EXACT)
    return np.asarray(solution.y[:, -1])


def moving_system(N: int) -> tuple[Model, System, Array, Array]:
    """A random system in moderate motion under inputs, away from the Euler angles' singularity."""
    rng = np.random.default_rng(1300 + N)
    system = random_system(rng, N)
    return Model(system), system, random_state(rng, N, rate=0.5), 0.3 * random_input(rng, N)


def deviation(case: reference.TrajectoryCase, sample: int, x: Array) -> float:
    """Largest difference to the stored sample.

    Attitudes are compared as matrices, which do not wrap.
    """
    own, stored = StateView(x), StateView(case.x[sample])
    blocks = [
        own.r0_I - stored.r0_I,
        own.v0_P - stored.v0_P,
        own.omega0_P - stored.omega0_P,
        own.e_P - stored.e_P,
        own.Omega_P - stored.Omega_P,
        own.omega_B - stored.omega_B,
        attitude(own.Theta0) - case.R0[sample],
        np.array([attitude(Theta) for Theta in own.Theta]) - case.R[sample],
    ]
    return max(float(np.abs(block).max()) for block in blocks)


@pytest.mark.parametrize("N", [1, 4])
def test_observed_order_is_five(N: int) -> None:
    """Halving the step divides the error at the end by 2^5, the order of the Dormand-Prince 5(4) pair."""
    model, _, x, u = moving_system(N)
    duration_s = 0.4
    end = exact(model, x, u, duration_s)
    steps = np.array([4, 8, 16, 32])
    errors = [np.abs(model.integrate(x, u, duration_s, int(k))[0] - end).max() for k in steps]
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert -ORDER_SLACK < order - NOMINAL_ORDER < ORDER_SLACK


@pytest.mark.parametrize("N", [1, 4])
def test_estimate_bounds_the_error_and_falls_with_its_order(N: int) -> None:
    """The returned number exceeds the true local error and, O(h^5) itself, falls 2^5 times when the step halves."""
    model, _, x, u = moving_system(N)
    durations = np.array([0.1, 0.05, 0.025, 0.0125])
    estimates = []
    for duration_s in durations:
        end, estimate = model.integrate(x, u, float(duration_s), 1)
        assert np.abs(end - exact(model, x, u, float(duration_s))).max() < estimate
        estimates.append(estimate)
    order = np.polyfit(np.log(durations), np.log(estimates), 1)[0]
    assert -ORDER_SLACK < order - NOMINAL_ORDER < ORDER_SLACK


def test_forces_are_held_over_all_steps() -> None:
    """Under external forces the end is that of the derivative under the same forces, over one step and several."""
    model, _, x, u = moving_system(3)
    F = random_forces(np.random.default_rng(1350), 3)
    end = exact(model, x, u, SHORT_STEP_S, F)
    for steps in (1, 4):
        found, estimate = model.integrate(x, u, SHORT_STEP_S, steps, forces=F)
        assert np.abs(found - end).max() < estimate
    # They do something.
    assert np.abs(end - exact(model, x, u, SHORT_STEP_S)).max() > 1e3 * estimate


@pytest.mark.parametrize("N", [1, 4])
def test_rods_stay_unit_and_do_not_spin(N: int) -> None:
    """|e_i| = 1 and e_i . Omega_i = 0 after `integrate`, paper section II-A."""
    model, _, x, u = moving_system(N)
    for _ in range(20):
        x, _ = model.integrate(x, u, 0.05, 20)
        view = StateView(x)
        assert np.abs(np.linalg.norm(view.e_P, axis=-1) - 1.0).max() < SAME_ROUNDING
        assert (
            np.abs((view.e_P * view.Omega_P).sum(axis=-1)).max()
            < SAME_ROUNDING * np.abs(view.Omega_P).max()
        )
