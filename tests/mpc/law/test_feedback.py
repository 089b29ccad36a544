"""The shared control law and the prediction with it."""

from contextlib import nullcontext
from functools import cache

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from tests.support.systems import Situation, changed, paper_setup, situation
from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.discretisation import zero_order_hold
from transport.model.state import input_indices
from transport.mpc.controller import Controller, Horizon
from transport.mpc.law.infinite_horizon_lqr import (
    HoveringTeam,
    _check_gain,
    _check_stable,
    regulator,
)
from transport.mpc.program.feedback_law import FeedbackError, FeedbackLaw
from transport.mpc.program.prediction import Prediction, convolve, predict
from transport.mpc.program.stage_cost import Cost
from transport.mpc.settings_period_horizon_weights import (
    ConstraintSection,
    ControllerSettings,
    CostTerm,
    PredictionName,
    Weights,
)

PERIOD_S = 0.05
CLOSED = ControllerSettings(prediction="closed_loop", relaxation=1.0)

# Both solve the same Riccati equation to rounding; the gain's entries reach 30.
GAIN_TOLERANCE = 1e-7
# The same linear recursion in another order of operations, over 20 steps with states of a few
# metres.
ROLLOUT_TOLERANCE = 1e-9
# Two programs with the same optimum, each solved to residuals of 1e-6 of data of size one.
OPTIMUM_TOLERANCE = 1e-6


@cache
def gain() -> Array:
    """The paper system's gain."""
    setup = paper_setup()
    cost = Cost(Weights(), setup.system, setup.hover)
    return regulator(HoveringTeam(model=setup.model, hover=setup.hover, cost=cost), PERIOD_S).K


def hover_model() -> tuple[Array, Array, Array]:
    """A, B, C of the paper system at hover."""
    setup = paper_setup()
    linear = setup.model.linearise(setup.hover.x, setup.hover.u)
    discrete = zero_order_hold(linear, PERIOD_S)
    return discrete.A, discrete.B, linear.C


def test_gain_is_the_regulators() -> None:
    """K is the LQR gain of an independent solver, which needs free headings and rod lengths taken out by hand."""
    setup = paper_setup()
    A, B, C = hover_model()
    kept = np.ones(setup.system.n, dtype=bool)
    for i in range(setup.system.N):
        block = state.uav_slice(i).start
        # Vertical rods: e and Omega cannot change along z; a heading costs nothing and changes
        # nothing.
        kept[[block + 2, block + 5, block + 8]] = False
    cost = Cost(Weights(), setup.system, setup.hover)
    a, b, c = A[np.ix_(kept, kept)], B[kept], C[:, kept]
    P = solve_discrete_are(a, b, c.T @ (cost.Q[:, None] * c), np.diag(cost.R))
    expected = -np.linalg.solve(np.diag(cost.R) + b.T @ P @ b, b.T @ P @ a)
    assert np.abs(gain()[:, kept] - expected).max() < GAIN_TOLERANCE
    assert np.abs(gain()[:, ~kept]).max() < GAIN_TOLERANCE


@pytest.mark.parametrize("owned", [(0,), (1, 3)])
def test_prediction_is_the_team_under_the_law(owned: tuple[int, ...]) -> None:
    """Stepping the linear model with the others' inputs from the control law gives the predicted states and inputs."""
    setup = paper_setup()
    rng = np.random.default_rng(3)
    at = situation(setup, CLOSED, seed=3)
    steps, own = 20, input_indices(owned)
    others = np.setdiff1d(np.arange(setup.system.m), own)
    discrete = zero_order_hold(setup.model.linearise(at.x, at.u), PERIOD_S)
    x_ref = at.x + 0.1 * rng.standard_normal((steps, setup.system.n))
    feedforward, c = rng.standard_normal((2, steps, setup.system.m))
    law = FeedbackLaw(
        K=gain(), u_rest=setup.hover.u, error=at.x - x_ref, feedforward=feedforward, c=c
    )
    prediction = predict(discrete, at.u, own, at.U, law)
    v = 0.1 * rng.standard_normal((steps, len(own)))
    predicted_U = prediction.U_all + convolve(prediction.feedback, v)
    predicted_U[:, own] = prediction.U_free + v

    dx = np.zeros(setup.system.n)
    for k in range(steps):
        u = np.empty(setup.system.m)
        u[own] = at.u[own] + v[k]
        u[others] = (setup.hover.u + gain() @ (at.x + dx - x_ref[k]) + feedforward[k] + c[k])[
            others
        ]
        assert np.abs(predicted_U[k] - u).max() < ROLLOUT_TOLERANCE
        dx = discrete.f_d + discrete.A @ dx + discrete.B @ (u - at.u)
        convolved = sum(prediction.effect[:, k - j] @ v[j] for j in range(k + 1))
        assert np.abs(prediction.dX_free[k + 1] + convolved - dx).max() < ROLLOUT_TOLERANCE


def test_foreseen_inputs_follow_the_law_within_bounds() -> None:
    """Inputs of all UAVs for given owned ones are those of the law, each limited to its bounds."""
    setup = paper_setup()
    at = situation(setup, CLOSED, seed=3)
    one = Controller(setup.model, setup.hover, CLOSED, (1,))
    law = law_at(one, at)
    linear = one.linearise(at.x, at.u)
    prediction = one.predict(linear, one.discretise(linear), at.U, law)
    lower, upper = CLOSED.lower(setup.system.N), CLOSED.upper(setup.system.N)
    assert isinstance(prediction, Prediction)
    # Owned inputs far beyond their bounds move those of the others beyond theirs.
    for far in (2.0, -2.0):
        inputs = prediction.U_free + far * (upper - lower)[one.own]
        unlimited = prediction.U_all + convolve(prediction.feedback, inputs - prediction.U_free)
        unlimited[:, one.own] = inputs
        is_own = np.isin(np.arange(setup.system.m), one.own)
        is_beyond = (unlimited < lower) | (unlimited > upper)
        assert is_beyond[:, is_own].any()
        assert is_beyond[:, ~is_own].any()
        expected = np.clip(unlimited, lower, upper)
        np.testing.assert_array_equal(one.foreseen(prediction, inputs), expected)


def test_owning_all_the_law_changes_nothing() -> None:
    """One agent that owns all solves the centralized problem, in these coordinates as in the others."""
    setup = paper_setup()
    all_uavs = tuple(range(setup.system.N))
    at = situation(setup, CLOSED, seed=5)
    plain = Controller(setup.model, setup.hover, ControllerSettings(), all_uavs)
    shared = Controller(setup.model, setup.hover, CLOSED, all_uavs)
    found = shared.step(at.x, at.u, Horizon(U=at.U, y_ref=at.y_ref, law=law_at(shared, at)))
    expected = plain.step(at.x, at.u, Horizon(U=at.U, y_ref=at.y_ref))
    assert found.solution.status == expected.solution.status == "solved"
    assert np.abs(found.U - expected.U).max() < OPTIMUM_TOLERANCE


def test_corrections_reproduce_the_inputs() -> None:
    """The announced corrections, run through the control law from the present state, give the announced inputs."""
    setup = paper_setup()
    at = situation(setup, CLOSED, seed=7)
    one = Controller(setup.model, setup.hover, CLOSED, (2,))
    law = law_at(one, at)
    assert law is not None
    linear = one.linearise(at.x, at.u)
    discrete = one.discretise(linear)
    prediction = one.predict(linear, discrete, at.U, law)
    optimum = one.conclude(
        one.solve(one.condense(linear, prediction, at.y_ref)), prediction, at.U, law
    )
    dx = np.zeros(setup.system.n)
    for k, c in enumerate(optimum.c):
        u = setup.hover.u + gain() @ (law.error[k] + dx) + law.c[k]
        u[one.own] += c - law.c[k, one.own]
        assert np.abs(u[one.own] - optimum.U[k]).max() < ROLLOUT_TOLERANCE
        dx = discrete.A @ dx + discrete.f_d + discrete.B @ (u - at.u)


def law_at(controller: Controller, at: Situation) -> FeedbackLaw | None:
    """The shared control law about a situation, with corrections as small as those of a run."""
    setup = paper_setup()
    rng = np.random.default_rng(1)
    steps = controller.settings.horizon
    x_ref = np.tile(setup.hover.x, (steps, 1))
    x_ref[:, :3] += at.x[:3]
    return controller.law(at.x, x_ref, 0.01 * rng.standard_normal((steps, setup.system.m)))


def test_a_start_is_not_relaxed_towards_nothing() -> None:
    """The first plan is the optimum itself, the next ones the mean of all optima, until that is the relaxation."""
    setup = paper_setup()
    at = situation(setup, CLOSED, seed=9)
    full = Controller(setup.model, setup.hover, CLOSED, (1,))
    part = Controller(
        setup.model,
        setup.hover,
        ControllerSettings(prediction="closed_loop", relaxation=0.25),
        (1,),
    )
    law = law_at(full, at)
    assert law is not None
    linear = part.linearise(at.x, at.u)
    prediction = part.predict(linear, part.discretise(linear), at.U, law)
    solution = part.solve(part.condense(linear, prediction, at.y_ref))
    best = full.conclude(solution, prediction, at.U, law).c
    before = law.c[:, full.own]
    assert np.abs(best - before).max() > 0.01, "nothing to relax: the comparison shows nothing"
    for ticks_since_start, share in [
        (0, 1.0),
        (1, 1 / 2),
        (2, 1 / 3),
        (3, 0.25),
        (100, 0.25),
        (None, 0.25),
    ]:
        c = part.conclude(solution, prediction, at.U, law, ticks_since_start).c
        assert np.abs(c - (share * best + (1.0 - share) * before)).max() < ROLLOUT_TOLERANCE


@pytest.mark.parametrize("owned", [(1,), (0, 2)])
@pytest.mark.parametrize(
    ("gone", "expression", "prediction", "correct_the_same"),
    [
        ((3,), None, "closed_loop", True),
        ((), None, "closed_loop", False),
        ((), "r0[2] <= 90", "closed_loop", True),
        ((), "thrust1 + thrust2 + thrust3 <= 190", "closed_loop", True),
        ((), "thrust4 <= 44", "closed_loop", False),
        ((3,), "r0[2] <= 90", "open_loop", False),
    ],
    ids=["lost", "none", "states", "shared inputs", "another's input", "open loop"],
)
def test_agents_that_correct_the_same_each_go_their_share_of_the_way(
    owned: tuple[int, ...],
    gone: tuple[int, ...],
    expression: str | None,
    prediction: PredictionName,
    correct_the_same: bool,
) -> None:
    """Of the way to their optimum agents go the share N_o / N: all together the whole, (30a).

    That is so where agents are lost, and with a constraint of the user that several keep, also after a
    lost agent has come back.
    """
    setup = paper_setup()
    at = situation(setup, CLOSED, seed=9)
    rows = () if expression is None else (ConstraintSection(expression=expression),)
    settings = changed(CLOSED, prediction=prediction, constraint=rows)
    one = Controller(setup.model, setup.hover, settings, owned)
    one.without((3,))
    one.without(gone)
    law = law_at(one, at)
    linear = one.linearise(at.x, at.u)
    prediction_of_step = one.predict(linear, one.discretise(linear), at.U, law)
    solution = one.solve(one.condense(linear, prediction_of_step, at.y_ref, law))

    def planned(ticks_since_start: int | None) -> Array:
        found = one.conclude(solution, prediction_of_step, at.U, law, ticks_since_start)
        return found.U if law is None else found.c

    best = planned(0)
    before = at.U[:, one.own] if law is None else law.c[:, one.own]
    assert np.abs(best - before).max() > 0.01, "nothing to relax: the comparison shows nothing"
    share = len(owned) / setup.system.N if correct_the_same else 1.0
    way = planned(None) - before
    assert np.abs(way - share * (best - before)).max() < ROLLOUT_TOLERANCE


def test_an_equation_that_overflows_is_refused_in_words() -> None:
    """A term of the cost with a slope of 1e150 leaves no numbers of a Riccati equation, (34)."""
    setup = paper_setup()
    settings = changed(CLOSED, cost=(CostTerm(expression="1e150 * r0[0]", weight=1.0),))
    with pytest.raises(FeedbackError, match="weights or slopes are too large"):
        Controller(setup.model, setup.hover, settings, (0,))


@pytest.mark.parametrize(
    ("growth_per_s", "gain", "got"),
    [
        (0.019, 99.0, None),
        (0.021, 1.0, "a closed loop whose largest eigenvalue is 1"),
        (0.0, 101.0, "a gain 101 times that of an integrator"),
    ],
)
def test_a_law_that_grows_or_rests_on_rounding_is_refused(
    growth_per_s: float, gain: float, got: str | None
) -> None:
    """A mode of a team may be out of reach, or be reached by rounding alone, with a gain far above sqrt(Q / R)."""
    system = paper_setup().system
    cost = Cost(Weights(attitude=5.0, thrust=1e-3), system, paper_setup().hover)
    period_s = 0.05
    A_closed = np.diag([0.5, -np.exp(growth_per_s * period_s)])
    K = np.zeros((system.m, system.n))
    K[0, 3] = -gain * np.sqrt(5.0 / 1e-3)
    refused = nullcontext() if got is None else pytest.raises(FeedbackError, match=got)
    with refused:
        _check_stable(A_closed, period_s)
        _check_gain(K, cost)
