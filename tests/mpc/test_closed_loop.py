"""Prediction along the shared control law, on the full nonlinear model."""

import numpy as np
import pytest

from transport.model.linear import motor_lag as motors
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import hover
from transport.model.physics.parameters import table_1
from transport.model.state import THETA, uav_slice
from transport.mpc.controller import Controller
from transport.mpc.program.prediction import Prediction, predict
from transport.mpc.program.rollout import Actuation, rollout
from transport.mpc.settings_period_horizon_weights import ControllerSettings

ON_THE_TRAJECTORY = 1e-9  # rounding over 40 steps


@pytest.mark.parametrize("lag_s", [0.0, 0.05])
def test_prediction_along_the_control_law_is_exact_on_it(lag_s: float) -> None:
    """If all UAVs follow the shared control law, the prediction is the nonlinear motion, also far from hover: (35a)."""
    system = table_1()
    model, at_rest = Model(system), hover(system)
    settings = ControllerSettings(
        prediction="closed_loop",
        terminal="riccati",
        linearisation="along",
        horizon=40,
        motor_lag_s=lag_s,
    )
    controller = Controller(model, at_rest, settings, (1,))
    x = at_rest.x.copy()
    x[[0, 1, 3, 7]] += [0.3, -0.2, 0.2, 0.1]
    z0 = np.concatenate([x, at_rest.u]) if lag_s else x
    law = controller.law(z0, np.tile(at_rest.x, (40, 1)), np.zeros((40, system.m)))
    assert law is not None
    linear = controller.linearise(z0, at_rest.u)
    prediction = controller.predict(
        linear, controller.discretise(linear), np.tile(at_rest.u, (40, 1)), law
    )
    assert isinstance(prediction, Prediction)
    z, V = z0, []
    lower, upper = settings.lower(4), settings.upper(4)
    for at_x0 in law.uncorrected:
        u = np.clip(at_x0 + law.K @ (z - z0), lower, upper)
        V.append(u[controller.own] - at_rest.u[controller.own])
        period = motors.Period(duration_s=settings.sampling_period_s, steps=1, lag_s=lag_s)
        z = motors.integrate(model, z, u, period)
    caused = sum(prediction.effect[:, 39 - j] @ V[j] for j in range(40))
    assert z0 + prediction.dX_free[-1] + caused == pytest.approx(z, abs=ON_THE_TRAJECTORY)
    assert np.abs(z - z0).max() > 0.1, (
        "far enough from the start to tell it from a linearisation there"
    )


def test_outputs_along_the_control_law_are_exact_on_its_trajectory() -> None:
    """If the outputs of the nonlinear motion are the reference, only effort has a gradient, (35a).

    A linearisation of the outputs at the first state is off by the curvature of their path.
    """
    system = table_1()
    model, at_rest = Model(system), hover(system)
    settings = ControllerSettings(prediction="closed_loop", linearisation="along", horizon=30)
    one = Controller(model, at_rest, settings, (1,))
    x0 = at_rest.x.copy()
    x0[[0, 1, 3, 7]] += [0.3, -0.2, 0.2, 0.1]
    steps = settings.horizon
    law = one.law(x0, np.tile(at_rest.x, (steps, 1)), np.zeros((steps, system.m)))
    assert law is not None
    Z, U = rollout(model, Actuation.of(settings, system.N), x0, law)
    Y = np.array([model.outputs(x) for x in Z])

    linear = one.linearise(x0, at_rest.u)
    prediction = one.predict(linear, one.discretise(linear), U, law)
    qp = one.condense(linear, prediction, Y, law)
    scale = (settings.upper(1) - settings.lower(1)) / 2.0
    deviation = U[:, one.own] - at_rest.u[one.own]
    effort = 2.0 * scale * one.cost.R[one.own] * deviation
    gradient = qp.H @ (deviation / scale).reshape(-1) + qp.g
    assert np.abs(gradient - effort.reshape(-1)).max() < ON_THE_TRAJECTORY

    expanded = linear.model.y + (Z - x0) @ linear.model.C.T
    assert np.abs(Y - expanded).max() > 0.01, "an expansion at the first state is as good"


@pytest.mark.parametrize(("roll_rad", "is_followed"), [(1.0, True), (1.4, False)])
def test_a_trajectory_that_tilts_too_far_is_not_followed(
    roll_rad: float, *, is_followed: bool
) -> None:
    """Near the singularity of Euler angles the prediction is the linear one about the present state, (35)."""
    system = table_1()
    model, at_rest = Model(system), hover(system)
    settings = ControllerSettings(prediction="closed_loop", linearisation="along", horizon=4)
    one = Controller(model, at_rest, settings, (1,))
    x0 = at_rest.x.copy()
    x0[uav_slice(0)][THETA.start] = roll_rad
    law = one.law(x0, np.tile(x0, (4, 1)), np.zeros((4, system.m)))
    assert law is not None
    linear = one.linearise(x0, at_rest.u)
    discrete = one.discretise(linear)
    U = np.tile(at_rest.u, (4, 1))
    found = one.predict(linear, discrete, U, law)
    assert isinstance(found, Prediction)

    about_x0 = predict(discrete, at_rest.u, one.own, U, law).dX_free
    is_linear = np.allclose(found.dX_free, about_x0, rtol=0.0, atol=ON_THE_TRAJECTORY)
    assert is_linear is not is_followed
