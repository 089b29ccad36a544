"""The controller's program against the cost of the paper and against the paper's own matrices; its arguments."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from tests.support import naive
from tests.support.systems import (
    Setup,
    Situation,
    changed,
    controller,
    paper_setup,
    situation,
    step,
)
from transport.model.arrays import Array
from transport.model.linear.motor_lag import with_lag
from transport.model.physics.hover import hover
from transport.mpc.settings_period_horizon_weights import (
    ConstraintSection,
    ControllerSettings,
    PenalisedInput,
    SeparationSection,
    Weights,
)

# Two sums of the same terms in another order, after the cancellation of the constant.
COST_AGREEMENT = 1e-9
# N and N m. Two solvers that both meet their optimality conditions to 1e-9, on a program with
# weights >= 1e-3.
PLAN_AGREEMENT = 1e-5
# N and N m. The same numbers mixed in the same way: only rounding.
MIX_AGREEMENT = 1e-12

OWNED = [(0,), (1, 3), (0, 1, 2, 3)]


def half_range(settings: ControllerSettings, uavs: int) -> Array:
    """Unit of the scaled decision: half the range of each input."""
    return (settings.upper(uavs) - settings.lower(uavs)) / 2.0


def cost_by_simulation(
    setup: Setup, settings: ControllerSettings, owned: tuple[int, ...], at: Situation, v: Array
) -> float:
    """The cost (25) for owned inputs u0 + v, all other inputs as announced.

    One simulated step after the other.
    """
    linear = setup.model.linearise(at.x, at.u)
    A, B, f_d = naive.exact_hold(linear, settings.sampling_period_s)
    own = [4 * i + j for i in owned for j in range(4)]
    dU = at.U - at.u
    dU[:, own] = v
    N = setup.system.N
    Q, R = settings.weights.Q(N), settings.weights.R(setup.system)[own]
    target = (
        setup.hover.u[own]
        if settings.weights.penalised_input == "deviation"
        else np.zeros(len(own))
    )
    total = 0.0
    for k, dx in enumerate(naive.simulate(A, B, f_d, dU)):
        error = linear.y + linear.C @ dx - at.y_ref[k]
        total += float(error @ (Q * error)) * (
            settings.weights.terminal if k == settings.horizon else 1.0
        )
    for effort in at.u[own] + v - target:
        total += float(effort @ (R * effort))
    return total


@pytest.mark.parametrize("penalised_input", ["deviation", "absolute"])
@pytest.mark.parametrize("horizon", [1, 2, 7])
@pytest.mark.parametrize("owned", OWNED)
def test_objective_is_the_cost_of_the_paper(
    owned: tuple[int, ...], horizon: int, penalised_input: PenalisedInput
) -> None:
    """Differences of the program's objective are differences of the cost (25), apart from the slack penalties."""
    setup = paper_setup()
    settings = ControllerSettings(
        horizon=horizon,
        weights=Weights(penalised_input=penalised_input),
        separation=SeparationSection(minimum_m=0.45, penalty=30.0),
    )
    at = situation(setup, settings, seed=horizon)
    one = controller(setup, settings, owned)
    linear = one.linearise(at.x, at.u)
    qp = one.condense(linear, one.predict(linear, one.discretise(linear), at.U, None), at.y_ref)
    rng = np.random.default_rng(11)
    scale = np.tile(half_range(settings, len(owned)), horizon)
    at_zero = cost_by_simulation(setup, settings, owned, at, np.zeros((horizon, 4 * len(owned))))
    for _ in range(5):
        z, slack = 0.3 * rng.standard_normal(len(scale)), rng.uniform(0.0, 0.2)
        cost = (
            cost_by_simulation(setup, settings, owned, at, (z * scale).reshape(horizon, -1))
            - at_zero
        )
        penalty = 30.0 * (slack + slack**2 / 2.0)
        assert qp.objective(np.append(z, slack)) == pytest.approx(
            cost + penalty, rel=COST_AGREEMENT
        )


def solve_as_printed(
    setup: Setup, settings: ControllerSettings, at: Situation, ceiling_m: float
) -> Array:
    """The centralized program (14)-(21) from the paper's stacked matrices, by a solver the project does not use.

    Input bounds and rates, a ceiling on the payload, and equal thrust of the first two UAVs are the
    constraints.
    """
    steps, m, n = settings.horizon, setup.system.m, setup.system.n
    linear = setup.model.linearise(at.x, at.u)
    A, B, f_d = naive.exact_hold(linear, settings.sampling_period_s)
    F, H = naive.stacked_drift(A, f_d, steps), naive.stacked_input(A, B, steps)
    C_bar = naive.stacked_output(linear.C, steps)
    Q = settings.weights.Q(setup.system.N)
    Q_bar = naive.stacked_weight(Q, settings.weights.terminal * Q, steps)
    R_bar = np.diag(np.tile(settings.weights.R(setup.system), steps))
    L, U_0 = np.tile(linear.y, steps + 1), np.tile(at.u, steps)
    error = L + C_bar @ F - at.y_ref.reshape(-1)
    P = 2.0 * (H.T @ C_bar.T @ Q_bar @ C_bar @ H + R_bar)
    q = 2.0 * (H.T @ C_bar.T @ Q_bar @ error + R_bar @ U_0)

    # Rate limits: differences of successive inputs, the first against the input in force.
    difference = np.eye(steps * m) - np.eye(steps * m, k=-m)
    rate = np.tile(settings.largest_step(setup.system.N), steps)
    altitude = np.zeros((steps, (steps + 1) * n))
    for k in range(steps):
        altitude[k, (k + 1) * n + 2] = 1.0
    equal_thrust = np.kron(np.eye(steps), np.eye(1, m, 0) - np.eye(1, m, 4))
    rows = np.vstack([difference, altitude @ H, equal_thrust])
    lower = np.concatenate([-rate, ceiling_m - at.x[2] - altitude @ F, -equal_thrust @ U_0])
    upper = np.concatenate([rate, np.full(steps, np.inf), -equal_thrust @ U_0])
    shape = {"h": ca.Sparsity.dense(P.shape), "a": ca.Sparsity.dense(rows.shape)}
    solver = ca.conic("printed", "qpoases", shape, {"printLevel": "none", "error_on_fail": True})
    answer = solver(
        h=P, g=q, a=rows, lba=lower, uba=upper,
        lbx=np.tile(settings.lower(setup.system.N), steps) - U_0,
        ubx=np.tile(settings.upper(setup.system.N), steps) - U_0,
    )  # fmt: skip
    return np.asarray((U_0 + np.asarray(answer["x"]).reshape(-1)).reshape(steps, m))


@pytest.mark.parametrize("solver", ["daqp", "clarabel"])
def test_owning_all_is_the_centralized_controller(solver: str) -> None:
    """With every UAV owned the plan is the optimum of the paper's (14)-(21), limits and constraints active."""
    setup, ceiling = paper_setup(), -10.01
    settings = ControllerSettings(
        horizon=6,
        weights=Weights(penalised_input="absolute"),
        constraint=(
            ConstraintSection(expression=f"r0[2] >= {ceiling}", soft=False),
            ConstraintSection(expression="thrust1 == thrust2"),
        ),
        solver="daqp" if solver == "daqp" else "clarabel",
    )
    y_ref = np.tile(setup.model.outputs(setup.x), (7, 1))
    # A metre up: into the ceiling, as fast as the rates allow.
    y_ref[:, 2 : 3 * setup.system.N : 3] -= 1.0
    rng = np.random.default_rng(5)
    u = setup.hover.u + 0.2 * rng.standard_normal(setup.system.m)
    u[4] = u[0]
    at = Situation(x=setup.x, u=u, U=np.tile(u, (6, 1)), y_ref=y_ref)
    optimum = step(controller(setup, settings, (0, 1, 2, 3)), at)
    expected = solve_as_printed(setup, settings, at, ceiling)
    assert optimum.solution.status == "solved"
    assert optimum.solution.solver == solver
    assert np.abs(optimum.solution.row_multipliers).max() > 0.1, (
        "a test without active constraints shows little"
    )
    assert np.abs(optimum.U - expected).max() < PLAN_AGREEMENT


@pytest.mark.parametrize("owned", OWNED)
def test_relaxation_mixes_with_the_shifted_plan(owned: tuple[int, ...]) -> None:
    """Relaxation w publishes w U* + (1 - w) U_shifted, the shifted plan being the owned announced columns."""
    setup, w = paper_setup(), 0.3
    full, relaxed = ControllerSettings(horizon=9), ControllerSettings(horizon=9, relaxation=w)
    at = situation(setup, full, seed=4)
    best, mixed = step(controller(setup, full, owned), at), controller(setup, relaxed, owned)
    shifted = at.U[:, mixed.own]
    assert np.allclose(
        step(mixed, at).U, w * best.U + (1.0 - w) * shifted, rtol=0.0, atol=MIX_AGREEMENT
    )


@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["below", "above"])
def test_mixed_plan_is_clipped(side: float) -> None:
    """With a shifted plan far outside its bounds the announced mean is clipped to them, (30a)."""
    setup, w = paper_setup(), 0.3
    full, relaxed = ControllerSettings(horizon=9), ControllerSettings(horizon=9, relaxation=w)
    at, mixed = situation(setup, full, seed=4), controller(setup, relaxed, (1,))
    at.U[:, mixed.own] += 10.0 * side * half_range(full, 1)
    best = step(controller(setup, full, (1,)), at)
    mean = w * best.U + (1.0 - w) * at.U[:, mixed.own]
    expected = np.clip(mean, full.lower(1), full.upper(1))
    assert (expected != mean).all(), "the mean is within the bounds"
    np.testing.assert_allclose(step(mixed, at).U, expected, rtol=0.0, atol=MIX_AGREEMENT)


@pytest.mark.parametrize("lag_s", [0.0, 0.05])
@pytest.mark.parametrize(
    ("kind", "is_at_hover"),
    [
        ({"prediction": "open_loop", "linearisation": "present"}, False),
        ({"prediction": "open_loop", "linearisation": "along"}, False),
        ({"prediction": "closed_loop", "linearisation": "present"}, False),
        ({"prediction": "closed_loop", "linearisation": "along"}, True),
    ],
    ids=lambda value: "-".join(value.values()) if isinstance(value, dict) else "",
)
def test_motion_is_that_of_the_present_state(
    kind: dict[str, Any], is_at_hover: bool, lag_s: float
) -> None:
    """f and h are those at x0, actual inputs and forces, (15), (55); derivatives along the law are those at hover."""
    setup = paper_setup()
    rng = np.random.default_rng(8)
    settings = changed(ControllerSettings(horizon=5, motor_lag_s=lag_s), **kind)
    at = situation(setup, settings, seed=8)
    forces = np.append(rng.standard_normal(3 + 3 * setup.system.N), 0.3)
    actual = at.u + rng.standard_normal(setup.system.m) if lag_s else at.u
    z0 = np.concatenate([at.x, actual]) if lag_s else at.x
    found = controller(setup, settings, (1,)).linearise(z0, at.u, forces).model

    f = setup.model.derivative(at.x, actual, forces=forces)
    about = setup.model.linearise(at.x, actual, forces=forces)
    if is_at_hover:
        about = setup.model.linearise(setup.hover.x, setup.hover.u)
    if lag_s:
        f = np.concatenate([f, (at.u - actual) / lag_s])
        about = with_lag(about, actual, at.u, lag_s)
    np.testing.assert_allclose(found.f, f, atol=MIX_AGREEMENT)
    np.testing.assert_allclose(found.y, setup.model.outputs(at.x), atol=MIX_AGREEMENT)
    for name in ("A_c", "B_c", "C"):
        np.testing.assert_array_equal(getattr(found, name), getattr(about, name))


@pytest.mark.parametrize("penalised_input", ["deviation", "absolute"])
def test_inputs_without_cost_carry_a_heavier_payload(penalised_input: PenalisedInput) -> None:
    """With a mass error deviations are those from the hover of that payload; an input itself begins at zero, (40)."""
    setup, further_kg = paper_setup(), 0.4
    settings = ControllerSettings(horizon=5, weights=Weights(penalised_input=penalised_input))
    forces = np.append(np.zeros(3 + 3 * setup.system.N), further_kg)
    found = controller(setup, settings, (1,)).linearise(setup.x, setup.hover.u, forces).u_target

    payload = replace(setup.system.payload, mass=setup.system.payload.mass + further_kg)
    heavier = hover(replace(setup.system, payload=payload)).u
    expected = heavier if penalised_input == "deviation" else np.zeros_like(heavier)
    np.testing.assert_allclose(found, expected, atol=PLAN_AGREEMENT)


@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["below", "above"])
def test_a_plan_that_is_given_up_is_the_shifted_one_within_bounds(side: float) -> None:
    """The announced inputs are clipped, the announced corrections go on, and the result is not "solved"."""
    setup = paper_setup()
    settings = ControllerSettings(horizon=9, prediction="closed_loop")
    at, one = situation(setup, settings, seed=4), controller(setup, settings, (1,))
    at.U[:, one.own] += 10.0 * side * half_range(settings, 1)
    c = np.random.default_rng(2).standard_normal(at.U.shape)
    law = one.law(at.x, np.tile(setup.x, (9, 1)), c)
    assert law is not None

    found = one.give_up(at.U, law)
    limit = settings.lower(1) if side < 0.0 else settings.upper(1)
    np.testing.assert_array_equal(found.U, np.tile(limit, (9, 1)))
    np.testing.assert_array_equal(found.c, c[:, one.own])
    assert found.solution.status != "solved"
