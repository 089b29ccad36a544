"""The control law along a flat reference, and the program about it."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import msgspec
import numpy as np
import pytest

from tests.model.path.test_flatness import unequal
from tests.support import naive
from tests.support.systems import INTEGRATION_STEPS
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.path.curves import Curve
from transport.model.path.flat_reference import FlatReference, Track
from transport.model.path.flatness import flight
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import Phase
from transport.model.physics.hover import hover
from transport.model.physics.obstacles import Obstacle, Solid, clearances
from transport.model.state import R0, V0, StateView, input_slice, uav_slice
from transport.mpc.controller import Controller, StepResult
from transport.mpc.law.reconfiguration import recursion_of
from transport.mpc.law.tracking_lqr import GAINS_PER_PERIOD
from transport.mpc.program.corrections_along_reference import Course
from transport.mpc.program.rollout import Actuation, rollout
from transport.mpc.program.trajectory import Signals
from transport.mpc.reference import Sampled
from transport.mpc.settings_period_horizon_weights import (
    ConstraintSection,
    ControllerSettings,
    CostTerm,
    Limits,
    SeparationSection,
    TensionSection,
    TiltSection,
    Weights,
)

PERIOD_S = 0.05
SETTINGS = ControllerSettings(
    horizon=12, prediction="closed_loop", linearisation="along", terminal="riccati", preview=True,
    weights=Weights(payload_position=1.0, payload_velocity=0.1, acceleration=5e-3, angular_acceleration=1.7e-3),
    limits=Limits(thrust_N=(0.0, 20.0), thrust_rate_N_s=200.0, moment_rates_Nm_s=(40.0, 40.0, 20.0)),
)  # fmt: skip
# Sums over the horizon of squares up to 10, through products of matrices.
SAME_COST = 1e-9
# Two recursions over thirty instants with entries of P up to 1e3.
SAME_GAIN = 1e-11
# Relative to the largest: two integration steps of each period against five.
SAME_FEEDFORWARD = 1e-4


@lru_cache
def flown(instants: int = 80) -> tuple[Model, Track]:
    """A quick arc."""
    system = unequal()
    curve = Curve(kind="eight", duration_s=8.0, ramp_s=3.5, size_I=(1.5, 0.7, 0.0))
    phase = Phase(name="eight", duration_s=8.0, displacement_I=[0, 0, 0], way=curve)
    rest = Phase(name="rest", duration_s=1.0, displacement_I=[0, 0, 0])
    maneuver = Maneuver(start_I=[0, 0, -9.0], phases=[phase, rest], profile="smooth")
    return Model(system), FlatReference(system, hover(system), maneuver).track(
        instants + 80, PERIOD_S
    )


@lru_cache
def flown_straight() -> tuple[Model, Track]:
    """A short way from rest to rest."""
    system = unequal()
    way = Curve(kind=None, duration_s=1.5, ramp_s=0.7, size_I=(0.3, 0.1, 0.0))
    phase = Phase(name="way", duration_s=1.5, displacement_I=way.size_I, way=way)
    maneuver = Maneuver(start_I=[0, 0, -9.0], phases=[phase], profile="smooth")
    return Model(system), FlatReference(system, hover(system), maneuver).track(32, PERIOD_S)


def controller(
    owned: tuple[int, ...] = (1,),
    settings: ControllerSettings = SETTINGS,
    obstacles: Sequence[Obstacle] = (),
) -> Controller:
    """Return a controller on the arc."""
    model, track = flown()
    return Controller(
        model, hover(model.system), settings, owned, Sampled(X=track.X, track=track), obstacles
    )


def test_cost_is_the_sum_of_squares_of_corrections() -> None:
    """From any state, corrections cost sum c' M c beyond the law.

    (72), simulated on (70) to the end at rest.
    """
    model, track = flown()
    one, rng, start = controller(), np.random.default_rng(1), 60
    moving = int(np.flatnonzero((track.X[-1] != track.X).any(axis=1)).max()) + 1 - start
    c = rng.normal(scale=0.1, size=(moving, model.system.m))
    law = one.law(track.X[start], track.X[start : start + moving], c, None, start)
    regulator = one.regulation.current.regulator
    assert law is not None
    assert law.gains is not None
    assert regulator is not None
    gains, cost, xi0 = law.gains, one.cost, np.zeros(model.system.n)
    xi0[R0] = [0.3, -0.2, 0.1]

    def total(c: Array) -> float:
        found, xi = 0.0, xi0
        for k in range(moving):
            y = model.linearise(track.X[start + k], track.U[start + k]).C @ xi
            u = law.K[k] @ xi + c[k]
            found += y @ (cost.Q * y) + u @ (cost.R * u)
            xi = gains[k].A_closed @ xi + gains[k].B @ c[k]
            xi = _on_manifold(track.X[start + k + 1], xi)
        return float(found + np.sum((regulator.root @ xi) ** 2))

    added = float(np.einsum("km,kmn,kn->", c, np.array([at.M for at in gains]), c))
    assert total(c) - total(0.0 * c) == pytest.approx(added, rel=SAME_COST)


def test_gains_are_those_of_a_recursion_in_homogeneous_coordinates() -> None:
    """Gains and feedforward equal those of the regulator of [xi, 1], (70), (71).

    Its only matrix is [A Pi, d; 0, 1], so the affine terms d and p follow from P alone.
    """
    term = CostTerm(expression="v0[1] * r0[0]", weight=0.7)
    model, track = flown_straight()
    settings = SETTINGS.model_copy(update={"cost": (term,)})
    one = Controller(model, hover(model.system), settings, (0,), Sampled(X=track.X, track=track))
    regulator, tracker = one.regulation.current.regulator, one.regulation.current.tracker
    assert regulator is not None
    assert tracker is not None

    largest = max(np.abs(at.feedforward).max() for at in tracker.gains)
    n, R = model.system.n, np.diag(one.cost.R)
    S = np.zeros((n + 1, n + 1))
    S[:n, :n] = regulator.T @ regulator.P @ regulator.T.T
    for k in reversed(range(len(tracker.gains) - 1)):  # at the last one the team rests
        x, x_ahead, u = track.X[k], track.X[k + 1], track.U[k]
        Pi = _on_manifold(x, np.eye(n))
        A, B, _ = naive.exact_hold(model.linearise(track.X_middle[k], u), PERIOD_S)
        moved, _ = model.integrate(x, u, PERIOD_S, INTEGRATION_STEPS)
        slope = np.zeros(n)
        slope[[R0.start, V0.start + 1]] = x[V0.start + 1], x[R0.start]
        C = model.linearise(x, u).C
        stage = C.T @ (one.cost.Q[:, None] * C) + term.weight * np.outer(slope, slope)

        A_whole, B_whole, Q_whole = np.eye(n + 1), np.zeros((n + 1, len(u))), np.zeros_like(S)
        A_whole[:n] = np.column_stack([A @ Pi, _on_manifold(x_ahead, moved - x_ahead)])
        B_whole[:n] = B
        Q_whole[:n, :n] = Pi @ stage @ Pi
        K = -np.linalg.solve(R + B_whole.T @ S @ B_whole, B_whole.T @ S @ A_whole)
        closed = A_whole + B_whole @ K
        S = Q_whole + K.T @ R @ K + closed.T @ S @ closed

        found = tracker.gains[k]
        assert np.abs(found.K - K[:, :n]).max() < SAME_GAIN * np.abs(K).max()
        assert np.abs(found.feedforward - K[:, n]).max() < SAME_FEEDFORWARD * largest


def _on_manifold(x: Array, xi: Array) -> Array:
    """Return deviations, (n,) or (n, ..), without their parts along the rods."""
    xi = xi.copy()
    for i, e in enumerate(StateView(x).e_P):
        for begin in (12 + 12 * i, 15 + 12 * i):
            xi[begin : begin + 3] -= np.outer(e, e) @ xi[begin : begin + 3]
    return xi


def step(one: Controller, x0: Array, c: Array, start: int = 60) -> tuple[Course, StepResult]:
    """One step along the reference, the others' corrections given."""
    _, track = flown()
    u0 = track.U[start - 1]
    law = one.law(x0, track.X[start : start + 12], c, None, start)
    linear = one.linearise(x0, u0)
    course = one.predict(linear, one.discretise(linear), track.U[start : start + 12], law)
    assert isinstance(course, Course)
    qp = one.condense(linear, course, np.zeros((13, 25)), law)
    return course, one.conclude(one.solve(qp), course, track.U[start : start + 12], law)


def test_decision_changes_signals_by_the_difference_equation() -> None:
    """A random decision changes states, inputs and functions of them by their slopes times the motion of (74).

    Values are those at the points of the trajectory: states of steps 1..N_p, inputs of 0..N_p - 1.
    """
    model, track = flown()
    one, rng = controller((0, 2)), np.random.default_rng(6)
    trajectory = step(one, track.X[60], np.zeros((12, model.system.m)))[0].trajectory
    X, U, own = trajectory.Z, trajectory.U, one.own

    z = rng.standard_normal(trajectory.decision.size)
    dc = np.zeros_like(U)
    dc[:, own] = trajectory.decision.inputs(z)
    dX, dU = np.zeros_like(X), np.zeros_like(U)
    for k, at in enumerate(trajectory.gains):
        dU[k] = at.K @ dX[k] + dc[k]
        dX[k + 1] = at.A_closed @ dX[k] + at.B @ dc[k]
    through_own = np.zeros_like(dU)
    through_own[:, own] = dU[:, own]

    r = model.outputs_along(X[1:])[:, : 3 * model.system.N]
    C = [model.linearise(x, U[0]).C[: r.shape[1]] for x in X[1:]]
    dr = np.array([C_k @ dx for C_k, dx in zip(C, dX[1:], strict=True)])
    both, d_both = np.hstack([X[:-1], U]), np.hstack([dX[:-1], dU])

    def check(found: Signals, values: Array, changes: Array) -> None:
        np.testing.assert_array_equal(found.values, values)
        effect = (found.effect @ z).reshape(values.shape)
        np.testing.assert_allclose(effect, changes, atol=SAME_COST * np.abs(changes).max())

    places = np.array([R0.start + 2, uav_slice(1).start])
    check(trajectory.own_inputs(), U[:, own], dU[:, own])
    check(trajectory.states(places), X[1:, places], dX[1:, places])
    for of, points, moves in (
        (trajectory.of_states, X[1:], dX[1:]),
        (trajectory.of_positions, r, dr),
        (trajectory.of_inputs, U, through_own),
        (trajectory.of_states_and_inputs, both, d_both),
    ):
        W = rng.standard_normal((3, points.shape[1]))

        def squares(at: Array, W: Array = W) -> tuple[Array, Array]:
            """Return sums of squares at one or several points, and their slopes."""
            return np.einsum("si,...i->...s", W, at**2 / 2.0), W * at[..., None, :]

        values = np.array([squares(point)[0] for point in points])
        check(of(squares), values, np.einsum("si,ki,ki->ks", W, points, moves))


def test_own_corrections_are_the_best_response_to_those_of_the_others() -> None:
    """Random corrections of the others: the own ones minimise sum c' M c of (72), whatever was announced."""
    model, track = flown()
    rng, own = np.random.default_rng(4), slice(4, 8)  # agent 2 of four inputs for each UAV
    announced = rng.normal(scale=0.01, size=(12, model.system.m))
    course, _ = step(controller(), track.X[60], announced)
    found = course.law.c
    others = np.ones(model.system.m, dtype=bool)
    others[own] = False
    np.testing.assert_array_equal(found[:, others], announced[:, others])
    for k, at in enumerate(course.trajectory.gains):
        # c' M c = |L' c|^2, a linear least-squares problem in the own entries.
        L = np.linalg.cholesky(at.M).T
        best, *_ = np.linalg.lstsq(L[:, own], -L[:, others] @ announced[k, others], rcond=None)
        assert np.abs(best).max() > 1e-5
        np.testing.assert_allclose(found[k, own], best, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("further_kg", [None, 3e-4], ids=["forces", "and mass"])
def test_the_law_is_about_the_motion_under_forces(further_kg: float | None) -> None:
    """State and inputs that it keeps are those of the flat motion under these forces, to first order, (73)."""
    model, track = flown()
    system, start, steps = model.system, 60, 12
    forces = 1e-4 * np.random.default_rng(9).uniform(1.0, 3.0, 3 + 3 * system.N)
    if further_kg is not None:
        forces = np.append(forces, further_kg)
    paths = np.ascontiguousarray(np.moveaxis(track.paths[start : start + steps], 0, 2))
    whole = np.append(forces[: 3 + 3 * system.N], further_kg or 0.0)
    X = flight(system, hover(system), paths[0], whole).x
    U = flight(system, hover(system), paths[1], whole).u

    x0, c = track.X[start], np.zeros((steps, system.m))
    law, without = (
        controller().law(x0, track.X[start : start + steps], c, given, start)
        for given in (forces, None)
    )
    assert law is not None
    assert without is not None
    for found, expected, unforced in (
        (law.error, x0 - X, without.error),
        (law.u_rest, U, without.u_rest),
    ):
        assert np.abs(expected - unforced).max() > 1e-5
        np.testing.assert_allclose(found, expected, atol=1e-7)


def test_along_a_later_track_the_law_is_the_same() -> None:
    """A track that begins in flight, as after a target, counts its rows from its first instant on."""
    model, track = flown_straight()
    first, start, steps = 5, 12, 6
    parts = {name: getattr(track, name)[first:] for name in ("X", "U", "X_middle", "paths")}
    later = replace(track, first=first, **parts)
    forces, c = np.full(3 + 3 * model.system.N, 0.1), np.zeros((steps, model.system.m))
    laws = []
    for each in (track, later):
        reference = Sampled(X=track.X, track=each)
        one = Controller(model, hover(model.system), SETTINGS, (0,), reference)
        laws.append(one.law(track.X[start], track.X[start : start + steps], c, forces, start))
    for name in ("K", "u_rest", "error", "feedforward"):
        found, expected = (getattr(law, name) for law in reversed(laws))
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_the_objective_is_the_added_cost_with_the_penalties() -> None:
    """sum dc' M dc of the owned corrections, and penalty (s + s^2 / 2) of each slack s, (74)."""
    settings = SETTINGS.model_copy(
        update={
            "tilt": TiltSection(limit_deg=12.0, penalty=30.0),
            "tension": TensionSection(minimum_N=3.0, penalty=7.0),
        }
    )
    model, track = flown()
    one, rng, start = controller((0, 2), settings), np.random.default_rng(8), 60
    x0 = track.X[start].copy()
    x0[R0] += [0.6, -0.5, 0.3]
    law = one.law(x0, track.X[start : start + 12], np.zeros((12, model.system.m)), None, start)
    linear = one.linearise(x0, track.U[start - 1])
    course = one.predict(linear, one.discretise(linear), track.U[start : start + 12], law)
    assert isinstance(course, Course)
    assert not course.within
    qp = one.condense(linear, course, np.zeros((13, 25)), law)

    decision = course.trajectory.decision
    z, slacks = rng.standard_normal(decision.size), rng.uniform(0.0, 0.2, 2)
    expected = 30.0 * (slacks[0] + slacks[0] ** 2 / 2.0) + 7.0 * (slacks[1] + slacks[1] ** 2 / 2.0)
    for dc, at in zip(decision.inputs(z), course.trajectory.gains, strict=True):
        expected += dc @ at.M[np.ix_(one.own, one.own)] @ dc
    assert qp.objective(np.append(z, slacks)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("off_limits", [False, True], ids=["within", "off limits"])
@pytest.mark.parametrize("w", [0.0, 0.5, 1.0])
def test_plan_mixes_the_optimum_with_what_was_announced(w: float, *, off_limits: bool) -> None:
    """Corrections are w (c* + dc) + (1 - w) c_announced, inputs follow from them within the limits, (30a), (74).

    A failed solution counts as w = 0: the announced ones.
    """
    model, track = flown()
    limits = Limits(
        thrust_N=(0.0, 14.0), thrust_rate_N_s=60.0, moments_Nm=(0.05, 0.05, 0.02),
        moment_rates_Nm_s=(0.4, 0.4, 0.2),
    ) if off_limits else SETTINGS.limits  # fmt: skip
    settings = SETTINGS.model_copy(update={"relaxation": w or 0.5, "limits": limits})
    one, start, own = controller(settings=settings), 60, slice(4, 8)
    x0, u0 = track.X[start].copy(), track.U[start - 1]
    x0[R0] += [0.6, -0.5, 0.3] if off_limits else [0.01, 0.0, 0.0]
    announced_c = np.random.default_rng(5).normal(scale=0.001, size=(12, model.system.m))
    announced = one.law(x0, track.X[start : start + 12], announced_c, None, start)
    assert announced is not None

    linear, U = one.linearise(x0, u0), track.U[start : start + 12]
    course = one.predict(linear, one.discretise(linear), U, announced)
    assert isinstance(course, Course)
    assert course.within is not off_limits
    solution = one.solve(one.condense(linear, course, np.zeros((13, 25)), announced))
    assert solution.status == "solved"
    dc = course.trajectory.decision.inputs(solution.z[: 12 * 4])
    assert dc.any() == off_limits
    if w == 0.0:
        solution = msgspec.structs.replace(solution, status="limit")
    result = one.conclude(solution, course, U, announced)

    c = announced_c.copy()
    c[:, own] = w * (course.law.c[:, own] + dc) + (1.0 - w) * announced_c[:, own]
    assert np.abs(course.law.c[:, own] - announced_c[:, own]).max() > 1e-4
    np.testing.assert_allclose(result.c, c[:, own], rtol=0.0, atol=1e-12)

    N = model.system.N
    largest = settings.largest_step(N)[own] + 1e-12
    first = (announced.uncorrected + c)[0, own]
    if not off_limits:
        followed = rollout(
            model, Actuation.of(settings, N), x0, msgspec.structs.replace(announced, c=c)
        ).U
        np.testing.assert_allclose(result.U, followed[:, own], rtol=0.0, atol=1e-9)
    assert (np.abs(np.diff(np.vstack([u0[own], result.U]), axis=0)) <= largest).all()
    low, high = np.array([0.0, -0.05, -0.05, -0.02]), np.array([14.0, 0.05, 0.05, 0.02])
    if off_limits:
        np.testing.assert_array_equal(np.clip(result.U, low, high), result.U)
        first = np.clip(np.clip(first, u0[own] - largest, u0[own] + largest), low, high)
    np.testing.assert_allclose(result.U[0], first, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("excess_N", "within"), [(5e-9, True), (2e-8, False)])
def test_a_plan_beyond_its_limits_by_rounding_is_at_them(excess_N: float, *, within: bool) -> None:
    """Up to 1e-9 of the range needs no program; the plan itself is within the limits to the last bit."""
    model, track = flown()
    most_N, x0 = 11.0, track.X[60]
    limits = SETTINGS.limits.model_copy(update={"thrust_N": (0.0, most_N)})
    one = controller(settings=SETTINGS.model_copy(update={"limits": limits}))
    law = one.law(x0, track.X[60:72], np.zeros((12, model.system.m)), None, 60)
    assert law is not None
    u_rest = law.u_rest.copy()
    u_rest[0, 4] += most_N + excess_N - law.uncorrected[0, 4]
    law = msgspec.structs.replace(law, u_rest=u_rest)

    linear, U = one.linearise(x0, track.U[59]), track.U[60:72]
    course = one.predict(linear, one.discretise(linear), U, law)
    assert isinstance(course, Course)
    assert course.U_all[0, 4] == pytest.approx(most_N + excess_N, abs=1e-12)
    assert course.within is within
    result = one.conclude(
        one.solve(one.condense(linear, course, np.zeros((13, 25)), law)), course, U, law
    )
    assert result.solution.status == "solved"
    assert 0.0 <= most_N - result.U[0, 0] < 1e-6


@pytest.mark.parametrize("w", [0.5, 1.0])
def test_course_and_plan_are_those_under_the_estimated_forces(w: float) -> None:
    """A constant push moves the predicted states, and inputs follow them by the law, (70), (74)."""
    model, track = flown()
    x0, actuation = track.X[60], Actuation.of(SETTINGS, model.system.N)
    one = controller(settings=SETTINGS.model_copy(update={"relaxation": w}))
    forces = np.full(3 + 3 * model.system.N, 0.2)
    announced_c = np.random.default_rng(5).normal(scale=0.001, size=(12, model.system.m))
    law = one.law(x0, track.X[60:72], announced_c, None, 60)
    assert law is not None

    linear = one.linearise(x0, track.U[59], forces)
    U = track.U[60:72]
    course = one.predict(linear, one.discretise(linear), U, law)
    assert isinstance(course, Course)
    assert course.within
    pushed, calm = (rollout(model, actuation, x0, course.law, given) for given in (forces, None))
    assert np.abs(pushed.Z - calm.Z).max() > 1e-3
    np.testing.assert_allclose(course.Z, pushed.Z, rtol=0.0, atol=1e-9)

    solution = one.solve(one.condense(linear, course, np.zeros((13, 25)), law))
    result = one.conclude(solution, course, U, law)
    c = announced_c.copy()
    c[:, 4:8] = result.c
    expected = rollout(model, actuation, x0, msgspec.structs.replace(law, c=c), forces).U
    np.testing.assert_allclose(result.U, expected[:, 4:8], rtol=0.0, atol=1e-9)


def test_hard_constraints_are_softened_in_the_newest_program() -> None:
    """That about the law's trajectory, and that about the present state without a law, has rows of its own, (30e)."""
    impossible = "r0[2] >= 5"
    constraint = ConstraintSection(expression=impossible, soft=False)
    settings = SETTINGS.model_copy(update={"constraint": (constraint,)})
    _, track = flown()
    one, start = controller((0, 1, 2, 3), settings), 60
    x0, U = track.X[start], track.U[start : start + 12]
    law = one.law(x0, track.X[start : start + 12], np.zeros((12, 16)), None, start)
    linear = one.linearise(x0, track.U[start - 1])
    y_ref = np.tile(linear.model.y, (13, 1))
    for given in (law, None, law):
        course = one.predict(linear, one.discretise(linear), U, given)
        solution = one.solve(one.condense(linear, course, y_ref, given))
        assert solution.status == "solved"
        assert solution.violations[impossible] == pytest.approx(5.0 - x0[R0][2], abs=1.0)


def test_no_corrections_on_and_near_the_reference() -> None:
    """Without others' corrections and within limits an agent has none, and follows the reference to its next state."""
    model, track = flown()
    assert controller().end(track.X[60], track.X[72]) is None, "the cost-to-go of hover"
    course, result = step(controller(), track.X[60], np.zeros((12, model.system.m)))
    assert course.within
    assert not result.c.any()
    np.testing.assert_allclose(course.Z[:, R0], track.X[60:73, R0], atol=1e-3)
    near = track.X[60].copy()
    near[R0] += 0.05
    one = controller()
    law = one.law(near, track.X[60:61], np.zeros((1, model.system.m)), None, 60)
    assert law is not None
    now = one.regulation.inputs(near, track.X[60], None, 60)
    np.testing.assert_array_equal(now, law.uncorrected[0])
    course, result = step(controller(), near, np.zeros((12, model.system.m)))
    assert course.within
    assert not result.c.any()


def test_law_of_another_team_is_the_same_by_parts_and_at_once() -> None:
    """An agent dies; until all gains are known, its UAV has the fail-safe's gain and the others keep theirs.

    No instant computes more gains than its share, also that of the death and the last one, whatever
    the host's speed.
    """
    by_parts, at_once, gone, since = controller().regulation, controller().regulation, {3}, 60
    before, tracker = by_parts.gain(since + 1), by_parts.current.tracker
    by_parts.form(gone, (), (), since=since)
    recursion = recursion_of(by_parts.current, tracker, since)  # that of the agent: shared by value
    assert recursion.computed == 0
    own = input_slice(3)
    meanwhile = by_parts.gain(since + 1)
    provisional = by_parts.current.tracker
    np.testing.assert_array_equal(by_parts.gain(since - 1), at_once.gain(since - 1))
    np.testing.assert_array_equal(meanwhile[: own.start], before[: own.start])

    ready = since
    done = False
    shares = []
    while not done:
        already = recursion.computed
        done = by_parts.advance(ready)
        shares.append(recursion.computed - already)
        ready += not done
    assert ready > since + 2
    assert shares[0] == 0
    assert max(shares) == GAINS_PER_PERIOD
    trackers = (tracker, provisional, by_parts.current.tracker)
    keys = {each.key for each in trackers if each is not None}
    assert len(keys) == 3, "laws that follow from another one are shared by its key"

    model, track = flown()
    other = Controller(
        model, hover(model.system), SETTINGS.model_copy(), (0,), Sampled(X=track.X, track=track)
    ).regulation
    other.form(gone, (), ())
    np.testing.assert_array_equal(meanwhile[own], other.gain(since + 1)[own])
    for k in (since, ready, 120):
        np.testing.assert_array_equal(by_parts.gain(k), other.gain(k))
        assert (by_parts.gain(k)[: own.start] != at_once.gain(k)[: own.start]).any()


def test_lost_uav_has_its_fail_safe_over_the_whole_horizon() -> None:
    """Until the gains are known its inputs at all steps are those of the final law, (45)."""
    model, track = flown()
    gone, since, steps = {3}, 60, SETTINGS.horizon
    changed, at_once = controller().regulation, controller().regulation
    changed.form(gone, (), (), since=since)
    at_once.form(gone, (), ())
    own, no_corrections = input_slice(3), np.zeros((steps, model.system.m))

    k = since
    while not changed.advance(k):
        found, final = (
            each.law(track.X[k], track.X[k : k + steps], no_corrections, None, k)
            for each in (changed, at_once)
        )
        assert found is not None
        assert final is not None
        np.testing.assert_array_equal(found.K[:, own], final.K[:, own])
        np.testing.assert_array_equal(found.uncorrected[:, own], final.uncorrected[:, own])
        k += 1
    assert k > since, "the law holds at once: nothing was compared"


@pytest.mark.parametrize(
    ("changed", "wanted"),
    [
        (
            {
                "limits": Limits(
                    thrust_N=(0.0, 14.0), thrust_rate_N_s=60.0, moments_Nm=(0.05, 0.05, 0.02)
                )
            },
            None,
        ),
        ({"separation": SeparationSection(minimum_m=0.44, penalty=1000.0)}, "separation"),
        ({"tilt": TiltSection(limit_deg=12.0, penalty=1000.0)}, "tilt"),
        ({"tension": TensionSection(minimum_N=3.0, penalty=1000.0)}, "tension"),
    ],
    ids=["inputs", "separation", "tilt", "tension"],
)
def test_program_keeps_limits_that_the_law_violates(
    changed: dict[str, object], wanted: str | None
) -> None:
    """Off the reference the law violates a limit.

    With the program's corrections the model keeps it.
    """
    model, track = flown()
    settings, start = SETTINGS.model_copy(update=changed), 60
    one = controller((0, 1, 2, 3), settings)
    x0 = track.X[start].copy()
    x0[R0] += [0.6, -0.5, 0.3]
    course, result = step(one, x0, np.zeros((12, model.system.m)))
    assert not course.within
    assert result.solution.status == "solved"
    assert result.c.any()
    law = one.law(x0, track.X[start : start + 12], result.c, None, start)
    assert law is not None
    Z, U = rollout(model, Actuation.of(settings, model.system.N), x0, law)
    # All UAVs are owned, so the plan is the trajectory; limits on states hold but for the
    # expansion's error.
    np.testing.assert_allclose(U, result.U, atol=1e-6)
    changes = np.abs(np.diff(np.vstack([track.U[start - 1], U]), axis=0))
    assert (changes <= settings.largest_step(4) + 1e-6).all()
    before, after = (_violation(model, settings, *of) for of in ((course.Z, course.U_all), (Z, U)))
    if wanted is not None:
        assert after < 0.25 * before


def _violation(model: Model, settings: ControllerSettings, Z: Array, U: Array) -> float:
    """Return the largest violation of distance, tilt or tension, m, rad or N."""
    worst = 0.0
    if settings.tension is not None:
        worst = max(
            settings.tension.minimum_N - model.tensions(x, u).min()
            for x, u in zip(Z, U, strict=False)
        )
    for x in Z[1:]:
        if settings.separation is not None:
            r = model.outputs(x)[:12].reshape(4, 3)
            apart = np.linalg.norm(r[:, None] - r, axis=2) + 9.0 * np.eye(4)
            worst = max(worst, settings.separation.minimum_m - float(apart.min()))
        if settings.tilt is not None:
            tilted = float(np.abs(StateView(x).Theta[:, :2]).max())
            worst = max(worst, tilted - math.radians(settings.tilt.limit_deg))
    return worst


@pytest.mark.parametrize(
    ("margin_m", "load_margin_m"), [(0.3, 0.0), (0.1, 0.3)], ids=["UAVs", "payload"]
)
def test_program_keeps_clear_of_an_obstacle(margin_m: float, load_margin_m: float) -> None:
    """The law leads 5 cm too near to a wall.

    With the program's corrections the model keeps the margin, (74a).
    """
    model, track = flown()
    start, bodies = 60, slice(0, 4) if margin_m > load_margin_m else slice(8, 9)
    x0, c = track.X[start].copy(), np.zeros((12, model.system.m))
    x0[R0] += [0.6, -0.5, 0.3]
    free, _ = step(controller(), x0, c)

    def least_m(Z: Array, obstacle: Obstacle) -> float:
        return float(clearances(model.system, obstacle, Z[1:])[:, bodies].min())

    def wall(y_m: float) -> Obstacle:
        solid = Solid(
            centre_I=np.array([0.0, y_m - 10.0, 0.0]),
            heading_rad=0.0,
            half=np.array([50.0, 10.0, np.inf]),
        )
        return Obstacle(
            name="", solids=(solid,), margin_m=margin_m, load_margin_m=load_margin_m, penalty=1e4
        )

    obstacle = wall(least_m(free.Z, wall(-20.0)) - 20.0 + 0.05 - max(margin_m, load_margin_m))
    one = controller((0, 1, 2, 3), obstacles=[obstacle])
    course, result = step(one, x0, c)
    law = one.law(x0, track.X[start : start + 12], result.c, None, start)
    assert not course.within
    assert law is not None
    assert least_m(course.Z, obstacle) == pytest.approx(
        max(margin_m, load_margin_m) - 0.05, abs=1e-6
    )
    assert (
        least_m(rollout(model, Actuation.of(SETTINGS, model.system.N), x0, law)[0], obstacle)
        > max(margin_m, load_margin_m) - 0.005
    )
    if load_margin_m < margin_m:
        return
    # Agents of one UAV each share the payload's correction: together they do about what one agent
    # does.
    together = np.zeros_like(c)
    for uav in range(4):
        alone = controller((uav,), obstacles=[obstacle])
        together[:, alone.own] = step(alone, x0, c)[1].c
    law = one.law(x0, track.X[start : start + 12], together, None, start)
    assert law is not None
    assert least_m(
        rollout(model, Actuation.of(SETTINGS, model.system.N), x0, law)[0], obstacle
    ) == pytest.approx(load_margin_m, abs=0.005)


def test_conflicting_obstacles_give_way_in_the_order_of_their_penalties() -> None:
    """Between two walls the payload keeps off that of the larger penalty as if the other were not there."""
    model, track = flown()
    start, margin_m, sides = 60, 0.3, (-1.0, 1.0)
    x0, c = track.X[start].copy(), np.zeros((12, model.system.m))
    x0[R0] += [0.6, -0.5, 0.3]

    def wall(side: float, y_m: float, penalty: float = 1.0) -> Obstacle:
        half = np.array([50.0, 10.0, np.inf])
        solid = Solid(centre_I=np.array([0.0, y_m + 10.0 * side, 0.0]), heading_rad=0.0, half=half)
        return Obstacle(
            name="", solids=(solid,), margin_m=0.0, load_margin_m=margin_m, penalty=penalty
        )

    def least_m(Z: Array, obstacle: Obstacle) -> float:
        return float(clearances(model.system, obstacle, Z[1:])[:, 8].min())

    free, _ = step(controller(), x0, c)
    apart_m = [least_m(free.Z, wall(side, 20.0 * side)) for side in sides]
    # The law leads 3 cm too near to both.
    faces = [
        side * (20.0 - far_m + margin_m - 0.03) for side, far_m in zip(sides, apart_m, strict=True)
    ]

    def kept_m(*penalties: float) -> list[float]:
        among = [wall(*of) for of in zip(sides, faces, penalties, strict=True) if of[-1] > 0.0]
        _, result = step(controller((0, 1, 2, 3), obstacles=among), x0, c)
        law = controller().law(x0, track.X[start : start + 12], result.c, None, start)
        assert law is not None
        return [
            least_m(rollout(model, Actuation.of(SETTINGS, model.system.N), x0, law)[0], obstacle)
            for obstacle in among
        ]

    first, second = kept_m(1e4, 1e2), kept_m(1e2, 1e4)
    assert first[0] == pytest.approx(kept_m(1e4, 0.0)[0], abs=1e-3)
    assert second[1] == pytest.approx(kept_m(0.0, 1e4)[0], abs=1e-3)
    assert second[0] < first[0] - 0.01


def test_meanwhile_the_closed_loop_is_that_of_its_gains() -> None:
    """Until the gains of the team that is left are known, each step is A + B K of those in force, (74)."""
    one, whole = controller().regulation, controller().regulation
    since = 60
    one.form({3}, (), (), since=since)
    assert one.current.tracker is not None
    assert whole.current.tracker is not None
    _, track = flown()
    rng = np.random.default_rng(3)
    for k in range(since, since + 5):
        (now,) = one.current.tracker.over(k, 1)
        (before,) = whole.current.tracker.over(k, 1)
        assert (now.K != before.K).any()
        deviation = _on_manifold(track.X[k], rng.standard_normal(len(track.X[k])))
        A_deviation = before.A_closed @ deviation - before.B @ before.K @ deviation
        expected = A_deviation + now.B @ now.K @ deviation
        np.testing.assert_allclose(now.A_closed @ deviation, expected, rtol=0.0, atol=1e-12)


def test_meanwhile_no_uav_follows_the_motion_of_a_released_one() -> None:
    """Until the gains are known the others keep theirs, but for those about the released UAV."""
    regulation, whole, since = controller().regulation, controller().regulation, 60
    regulation.form({3}, {3}, {3}, since=since)
    assert not regulation.advance(since), "the law holds at once"
    found, before = regulation.gain(since), whole.gain(since)
    others = slice(0, input_slice(3).start)
    expected = before[others].copy()
    assert expected[:, uav_slice(3)].any()
    expected[:, uav_slice(3)] = 0.0
    np.testing.assert_array_equal(found[others], expected)


@pytest.mark.parametrize("released", [(), (3,)], ids=["death", "release"])
def test_law_of_another_team_after_the_reference_has_come_to_rest(
    released: tuple[int, ...],
) -> None:
    """The law of the team that is left holds a tick later; the gains are those computed at once."""
    model, track = flown(200)
    reference = Sampled(X=track.X, track=track)
    changed, at_once = (
        Controller(model, hover(model.system), SETTINGS, (1,), reference).regulation
        for _ in range(2)
    )
    tracker = changed.current.tracker
    assert tracker is not None
    since = len(tracker.gains) + 5
    assert since < len(track.U)

    changed.form({3}, released, released, since=since)
    meanwhile = changed.gain(since)
    assert not changed.advance(since)
    assert changed.advance(since + 1)
    at_once.form({3}, released, released)
    own = input_slice(3)
    np.testing.assert_array_equal(meanwhile[own], at_once.gain(since)[own])
    for k in (since + 1, since + 20):
        np.testing.assert_array_equal(changed.gain(k), at_once.gain(k))


def test_tensions_along_a_reference_after_a_release() -> None:
    """Limits are those of the rods of the team that is left; the bob's has none, (30b), (51)."""
    model, track = flown(200)
    released, start, steps, least_N = 3, 220, SETTINGS.horizon, 100.0
    settings = SETTINGS.model_copy(update={"tension": TensionSection(minimum_N=least_N)})
    reference = Sampled(X=track.X, track=track)
    one = Controller(model, hover(model.system), settings, (0, 1, 2, 3), reference)
    one.fail({released}, {released})
    left = one.regulation.current.track
    assert left is not None
    x, u = left.X[start], left.U[start]

    law = one.law(x, left.X[start : start + steps], np.zeros((steps, len(u))), None, start)
    linear = one.linearise(x, u)
    course = one.predict(linear, one.discretise(linear), left.U[start : start + steps], law)
    limits = one.condense(linear, course, np.zeros((steps + 1, 25)), law).row_upper[-4 * steps :]
    expected = one.model.tensions(x, u) - least_N
    expected[released] = np.inf
    np.testing.assert_allclose(limits.reshape(steps, -1)[0], expected)
