"""A controller that knows the lag of the motors.

Prediction, control law and their limit without lag.
"""

import numpy as np
import pytest
from scipy.linalg import expm

from tests.support.systems import Situation, changed, paper_setup, situation
from transport.model.arrays import Array
from transport.model.kernels.native import Places
from transport.model.linear.linearisation import Linearisation
from transport.model.state import input_indices
from transport.mpc.controller import Controller, Horizon, StepResult
from transport.mpc.law.infinite_horizon_lqr import HoveringTeam, regulator
from transport.mpc.program.prediction import Prediction, convolve
from transport.mpc.program.stage_cost import Cost
from transport.mpc.settings_period_horizon_weights import (
    ConstraintSection,
    ControllerSettings,
    CostTerm,
    SeparationSection,
    TiltSection,
    Weights,
)

PERIOD_S = 0.05
SETTINGS = ControllerSettings(
    prediction="closed_loop", terminal="riccati", preview=False, horizon=8
)
# With rows and terms that read states, but for tensions and clearances from obstacles.
FULL = changed(
    SETTINGS,
    separation=SeparationSection(minimum_m=0.45),
    tilt=TiltSection(limit_deg=20.0),
    constraint=(
        ConstraintSection(expression="r0[2] <= -2"),
        ConstraintSection(expression="thrust1 + thrust2 <= 60"),
    ),
    cost=(CostTerm(expression="v0[0]", weight=0.3),),
)
# Two ways to sum up some hundred products of numbers up to 100.
SAME = 1e-9
# The fastest sampled mode of a team with motors of 100 ms and a control law that does not know them
# grows by this at least in a period; headings, which have no cost, neither grow nor decay.
GROWS, RESTS = 1.01, 1.0 + 1e-6


def lagging(at: Situation, rng: np.random.Generator) -> Array:
    """Return the state of a situation with actual inputs that are not the inputs in force."""
    return np.concatenate([at.x, at.u + 0.1 * rng.standard_normal(len(at.u))])


def simulated(
    plain: Linearisation, z: Array, u0: Array, commands: Array, lag_s: float
) -> tuple[Array, Array]:
    """Return states and actual inputs of the linear system under commands, step by step, as deviations from z."""
    A, B, f = plain.A_c, plain.B_c, plain.f
    n, m = B.shape
    actual, command = slice(n, n + m), slice(n + m, n + 2 * m)
    whole = np.zeros((n + 2 * m + 1, n + 2 * m + 1))
    # dx' = A dx + B da + f
    whole[:n] = np.hstack([A, B, np.zeros((n, m)), f[:, None]])
    # da' = (u - a) / lag
    whole[actual, actual] = -np.eye(m) / lag_s
    whole[actual, command] = np.eye(m) / lag_s
    whole[actual, -1] = (u0 - z[n:]) / lag_s
    hold = expm(PERIOD_S * whole)[: n + m]
    dz = [np.zeros(n + m)]
    for u in commands:
        dz.append(hold @ np.concatenate([dz[-1], u - u0, [1.0]]))
    found = np.array(dz)
    return found[:, :n], found[:, n:]


@pytest.mark.parametrize("lag_s", [0.03, 0.1])
@pytest.mark.parametrize("shared", [False, True])
def test_prediction_is_the_simulation(lag_s: float, shared: bool) -> None:
    """The prediction equals the augmented linear system under the same commands, open and closed loop, (55), (36)."""
    setup, rng = paper_setup(), np.random.default_rng(2)
    settings = changed(SETTINGS, motor_lag_s=lag_s)
    if not shared:
        settings = changed(settings, prediction="open_loop")
    one = Controller(setup.model, setup.hover, settings, (1, 2))
    at = situation(setup, settings, seed=3)
    z, n = lagging(at, rng), setup.system.n
    c = 0.1 * rng.standard_normal(at.U.shape)
    law = one.law(z, np.tile(setup.x, (len(c), 1)), c)
    linear = one.linearise(z, at.u)
    prediction = one.predict(linear, one.discretise(linear), at.U, law)
    assert isinstance(prediction, Prediction)
    v = 0.3 * rng.standard_normal(prediction.U_free.shape)
    v[:, ::4] *= 10.0
    dX = prediction.dX_free.copy()
    dX[1:] += np.array(
        [
            np.einsum("njm,jm->n", prediction.effect[:, :k], v[:k][::-1])
            for k in range(1, len(v) + 1)
        ]
    )
    commands = inputs_of(prediction, v, one.own)
    plain = setup.model.linearise(at.x, z[n:])
    states, actual = simulated(plain, z, at.u, commands, lag_s)
    np.testing.assert_allclose(dX[:, :n], states, rtol=0.0, atol=SAME)
    np.testing.assert_allclose(dX[:, n:], actual, rtol=0.0, atol=SAME)
    if law is not None:
        others = np.setdiff1d(np.arange(setup.system.m), one.own)
        K_x, K_a = law.K[:, :n], law.K[:, n:]
        by_law = (
            setup.hover.u
            + (at.x + states[:-1] - setup.x) @ K_x.T
            + (z[n:] + actual[:-1] - setup.hover.u) @ K_a.T
            + c
        )
        np.testing.assert_allclose(commands[:, others], by_law[:, others], rtol=0.0, atol=SAME)


def inputs_of(prediction: Prediction, v: Array, own: Places) -> Array:
    """Return the commands of all UAVs for decisions v, (N_p, m_own)."""
    U = prediction.U_all + (convolve(prediction.feedback, v) if len(prediction.feedback) else 0.0)
    U[:, own] = prediction.U_free + v
    return np.asarray(U)


def solved(settings: ControllerSettings, z: Array, at: Situation) -> StepResult:
    """Return the step of agent 2."""
    setup = paper_setup()
    one = Controller(setup.model, setup.hover, settings, (1,))
    law = one.law(z, np.tile(setup.x, (settings.horizon, 1)), np.zeros_like(at.U))
    end = one.end(z, setup.x)
    found = one.step(z, at.u, Horizon(U=at.U, y_ref=at.y_ref, law=law, end=end))
    assert found.solution.status == "solved"
    return found


def test_lag_to_zero() -> None:
    """Constraints, terms and plan become those of the controller without lag, in proportion to the lag."""
    at = situation(paper_setup(), FULL, seed=5, size=0.02)
    without = solved(FULL, at.x, at)
    differences = []
    for lag_s in (4e-3, 2e-3, 1e-3):
        found = solved(changed(FULL, motor_lag_s=lag_s), np.concatenate([at.x, at.u]), at)
        differences.append(np.abs(found.U - without.U).max())
    ratios = np.divide(differences[:-1], differences[1:])
    assert differences[-1] < 0.05 * np.abs(without.U - paper_setup().hover.u[4:8]).max()
    assert (np.abs(ratios - 2.0) < 0.3).all(), (differences, ratios)


def test_the_law_of_motors_stabilises_what_the_other_does_not() -> None:
    """With 100 ms of lag the gain without it has a growing mode, the gain that knows it has none, (33), (55)."""
    setup, lag_s = paper_setup(), 0.1
    cost = Cost(Weights(), setup.system, setup.hover)
    hovering = HoveringTeam(model=setup.model, hover=setup.hover, cost=cost)
    knows = regulator(hovering, PERIOD_S, motor_lag_s=lag_s)
    ignores = regulator(hovering, PERIOD_S)
    T, n = knows.T, setup.system.n
    one = Controller(setup.model, setup.hover, changed(SETTINGS, motor_lag_s=lag_s), (0,))
    discrete = one.discretise(
        one.linearise(np.concatenate([setup.hover.x, setup.hover.u]), setup.hover.u)
    )

    def largest(K: Array) -> float:
        return float(np.abs(np.linalg.eigvals(T.T @ (discrete.A + discrete.B @ K) @ T)).max())

    assert largest(knows.K) < RESTS
    assert largest(np.hstack([ignores.K, np.zeros((len(ignores.K), len(T) - n))])) > GROWS


def test_motors_of_failed_uavs_are_left_out() -> None:
    """A UAV without motors has no part in the control law.

    That of the others remains one of their motors.
    """
    setup = paper_setup()
    one = Controller(setup.model, setup.hover, changed(SETTINGS, motor_lag_s=0.05), (0,))
    one.fail([2], [2])
    found = one.regulation.current.regulator
    assert found is not None
    gone = setup.system.n + input_indices([2])
    assert not found.K[:, gone].any()
    assert not found.K[input_indices([2])].any()
    assert found.K[:, setup.system.n + input_indices([1])].any()
