"""Measurements of the UAVs' own sensors.

Their derivatives, and the specific force against the motion.
"""

import numpy as np

from tests.support.runs import setup
from transport.model.linear.linearisation import Model
from transport.model.physics.parameters import table_1
from transport.model.physics.rotations import rotation
from transport.model.state import SENSED, SPECIFIC_FORCE, StateView

STEP = 1e-6  # of the differences
SLOPES = 1e-7  # of derivatives of at most 10: the rounding of central differences
# Forward difference of velocities of accelerations below 10 m/s^2 over 1e-5 s.
FORCE = 1e-4


def _moving() -> tuple[Model, np.ndarray, np.ndarray, np.ndarray]:
    """Return a model, and a state in motion with inputs and forces."""
    run, rng = setup(), np.random.default_rng(3)
    u = run.hover.u + np.tile([2.0, 0.1, 0.1, 0.1], 4) * rng.uniform(-1.0, 1.0, 16)
    model = Model(table_1())
    return model, model.integrate(run.initial_state(), u, 0.4, 8)[0], u, rng.standard_normal(15)


def test_derivatives_by_state_and_forces() -> None:
    """The derivatives of (61) are those of central differences."""
    model, x, u, F = _moving()
    n = len(x)

    def y(step: np.ndarray) -> np.ndarray:
        return model.sense(x + step[:n], u, forces=F + step[n:])[0]

    found = model.sense(x, u, forces=F)[1]
    expected = [(y(step) - y(-step)) / (2.0 * STEP) for step in STEP * np.eye(n + 15)]
    np.testing.assert_allclose(found, np.column_stack(expected), atol=SLOPES)


def test_specific_force_is_acceleration_without_gravity() -> None:
    """The specific force is the derivative of the velocity minus gravity, in body axes."""
    model, x, u, F = _moving()
    step = 1e-5
    ahead = x + step * model.derivative(x, u, forces=F)
    acceleration = (model.velocities(ahead) - model.velocities(x))[1:] / step - [
        0.0,
        0.0,
        model.system.gravity,
    ]
    expected = [
        rotation(Theta).T @ a for Theta, a in zip(StateView(x).Theta, acceleration, strict=True)
    ]
    found = model.sense(x, u, forces=F)[0].reshape(-1, SENSED)
    np.testing.assert_allclose(found[:, SPECIFIC_FORCE], expected, atol=FORCE)
