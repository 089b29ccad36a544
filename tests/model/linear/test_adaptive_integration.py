"""Adaptive integration.

Accurate at the plant's defaults, in calm and violent motion, with the same bits everywhere.
"""

import numpy as np
import pytest

from tests.model.linear.test_integration import HELD_THRUST, TRAJECTORY_TOLERANCE, deviation, exact
from tests.support import reference
from tests.support.random_systems import random_input, random_state, random_system
from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.integration import StepLimits, integrate
from transport.model.state import StateView
from transport.protocol.scenario.sections.plant_sections import PlantSection

PERIOD_S, PERIODS = 0.05, 2
DEFAULT = PlantSection()
STEPS = round(PERIOD_S / DEFAULT.step_s)
SINGULAR_DEG = 89.0  # pitch at which Euler rates are 57 times body rates


def violent(case: int) -> tuple[Model, Array, Array]:
    """One of the random states of hard spins, two fifths of them with a body 1 degree from its Euler singularity."""
    rng = np.random.default_rng(4200 + case)
    N = 1 + case % 6
    system = random_system(rng, N)
    x, u = random_state(rng, N, rate=4.0), random_input(rng, N)
    if case % 5 == 0:
        StateView(x).Theta0[1] = np.radians(SINGULAR_DEG)
    if case % 5 == 1:
        StateView(x).Theta[0, 1] = np.radians(-SINGULAR_DEG)
    return Model(system), x, u


def at_defaults(model: Model, x: Array, u: Array) -> tuple[Array, float]:
    """State after some periods of the plant, and the largest error estimate."""
    largest = 0.0
    for _ in range(PERIODS):
        x, error = model.integrate(x, u, PERIOD_S, STEPS, tolerance=DEFAULT.tolerance)
        largest = max(largest, error)
    return x, largest


@pytest.mark.parametrize("name", HELD_THRUST)
def test_reference_trajectories_at_the_defaults(name: str) -> None:
    """The plant's default settings pass through every stored sample of the engines' trajectories, paper (2)-(10)."""
    case = reference.trajectory(name)
    model, x = Model(case.system), case.x[0]
    for k, u in enumerate(case.u):
        x, _ = model.integrate(x, u, case.period_s, STEPS, tolerance=DEFAULT.tolerance)
        assert deviation(case, k + 1, x) < TRAJECTORY_TOLERANCE


@pytest.mark.parametrize("case", range(20))
def test_random_violent_trajectories_are_exact(case: int) -> None:
    """Random systems in violent motion move as by SciPy's DOP853, at the plant's default settings."""
    model, x, u = violent(case)
    end, _ = at_defaults(model, x, u)
    assert np.abs(end - exact(model, x, u, PERIODS * PERIOD_S)).max() < TRAJECTORY_TOLERANCE


def test_calm_motion_has_the_bits_of_equal_steps() -> None:
    """Where the equal steps are accurate the tolerance changes no bit, also beyond one block of steps."""
    rng = np.random.default_rng(4300)
    system = random_system(rng, 3)
    model, x, u = Model(system), random_state(rng, 3, rate=0.1), 0.1 * random_input(rng, 3)
    for steps in (10, 150):
        end, error = model.integrate(x, u, PERIOD_S, steps)
        with_tolerance = model.integrate(x, u, PERIOD_S, steps, tolerance=DEFAULT.tolerance)
        assert error < DEFAULT.tolerance
        assert with_tolerance[0].tobytes() == end.tobytes()
        assert with_tolerance[1] == error


@pytest.mark.parametrize(
    ("limits", "steps"),
    [
        (StepLimits(tolerance=DEFAULT.tolerance, most_tried=50), 1),
        (StepLimits(tolerance=DEFAULT.tolerance, shortest=1.0), STEPS),
    ],
    ids=["most", "shortest"],
)
def test_work_is_bounded_and_the_error_stated(limits: StepLimits, steps: int) -> None:
    """Where the shortest or the most steps do not suffice, the integration ends with a larger error."""
    model, x, u = violent(0)
    _, error = integrate(model.step(u), x, PERIOD_S, steps, limits)
    assert error > DEFAULT.tolerance


def test_a_state_that_overflows_ends_the_integration() -> None:
    """A state beyond the floats ends the integration after the shortest steps, with an estimate that is not finite."""
    model, x, u = violent(2)
    x[state.OMEGA0] = 1e200
    end, error = model.integrate(x, u, PERIOD_S, STEPS, tolerance=DEFAULT.tolerance)
    assert not np.isfinite(end).all()
    assert not error <= DEFAULT.tolerance
