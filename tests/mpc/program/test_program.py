"""Prediction and QP against the paper's stacked matrices, and the compiled kernels against the matrix products."""

from dataclasses import fields, replace
from typing import Any, Literal

import msgspec
import numpy as np
import pytest

from tests.support import naive
from tests.support.programs import random_qp
from tests.support.systems import paper_setup, ring_setup, situation
from transport.model.arrays import Array, frozen
from transport.model.kernels import native
from transport.model.linear.discretisation import Discrete
from transport.mpc.controller import Controller
from transport.mpc.program.feedback_law import FeedbackLaw
from transport.mpc.program.horizon_and_terminal_cost import CostToGo
from transport.mpc.program.prediction import (
    Prediction,
    convolve,
    free_response,
    predict,
    stacked,
)
from transport.mpc.program.qp_solvers import solve_clarabel, within_bounds
from transport.mpc.program.quadratic_program import QP, residuals
from transport.mpc.settings_period_horizon_weights import (
    ConstraintSection,
    ControllerSettings,
    CostTerm,
    PredictionName,
    SeparationSection,
    TiltSection,
)

needs_kernels = pytest.mark.skipif(
    not native.AVAILABLE, reason="no compiled kernels: no C compiler, or switched off"
)

# Both sides are sums of the same products in another order: only rounding, relative to the largest
# entry.
ROUNDING = 1e-12
# The same of sums over the horizon whose terms cancel.
CANCELLED = 1e-10

# Of random deviations: the team has a trajectory along the law; it tilts too far for one.
SMALL, STEEP = 0.05, 1.0

# (states, owned inputs, others' inputs, outputs, horizon): scalars, horizon 1 and 2, wide, tall,
# many steps.
SIZES = [
    (1, 1, 1, 1, 1),
    (3, 2, 1, 2, 1),
    (4, 1, 3, 5, 2),
    (2, 3, 2, 1, 3),
    (6, 2, 4, 3, 7),
    (5, 4, 4, 4, 20),
]


def close(left: Array, right: Array, within: float = ROUNDING) -> bool:
    """Equal up to rounding relative to the largest entry."""
    scale = max(1.0, float(np.abs(right).max(initial=0.0)))
    return left.shape == right.shape and bool(
        np.abs(left - right).max(initial=0.0) <= within * scale
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_prediction_is_that_of_the_stacked_matrices(
    size: tuple[int, int, int, int, int], seed: int
) -> None:
    """dX = F + G dx(k) + H_i dU_i + H-bar_i dU-bar_i, paper (24), with dx(k) = 0 and any choice of owned inputs.

    Rows of a signal s = S x at steps 1..N_p are S-bar H of paper (16) without its first, zero block
    row; the owned columns of the announced inputs are the decision itself, so their content changes
    nothing.
    """
    n, m, others, p, steps = size
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    # Powers neither explode nor vanish over the horizon, so that every block counts in the
    # comparison.
    A /= max(abs(np.linalg.eigvals(A)))
    B, f_d, C = (
        rng.standard_normal((n, m + others)),
        rng.standard_normal(n),
        rng.standard_normal((p, n)),
    )
    u0, U, v = (
        rng.standard_normal(m + others),
        rng.standard_normal((steps, m + others)),
        rng.standard_normal((steps, m)),
    )
    own = np.sort(rng.permutation(m + others)[:m])
    rest = np.setdiff1d(np.arange(m + others), own)
    announced = U.copy()
    announced[:, own] += 5.0
    prediction = predict(Discrete(A=A, B=B, f_d=f_d), u0, own, announced)

    expected = naive.stacked_drift(A, f_d, steps)
    expected += naive.stacked_input(A, B[:, own], steps) @ v.reshape(-1)
    expected += naive.stacked_input(A, B[:, rest], steps) @ (U - u0)[:, rest].reshape(-1)
    decided = (stacked(prediction.effect) @ v.reshape(-1)).reshape(steps, n)
    assert close((prediction.dX_free + np.vstack([np.zeros(n), decided])).reshape(-1), expected)
    assert np.array_equal(prediction.U_free, np.tile(u0[own], (steps, 1)))
    outputs = naive.stacked_output(C, steps) @ naive.stacked_input(A, B[:, own], steps)
    assert close(stacked(np.tensordot(C, prediction.effect, 1)), outputs[p:])
    W = rng.standard_normal((steps, n))
    assert close(free_response(A, W), naive.simulate(A, np.eye(n), np.zeros(n), W))


ALL_ROWS: dict[str, Any] = {
    "separation": SeparationSection(minimum_m=0.45),
    "tilt": TiltSection(limit_deg=12.0),
    "constraint": (
        ConstraintSection(expression="dot(v0, v0) <= 1.0"),
        ConstraintSection(expression="thrust1 + thrust2 <= 45"),
    ),
    "cost": (
        CostTerm(expression="v0[0] * v0[1]", weight=0.3),
        CostTerm(expression="e1[0]", weight=2.0),
    ),
}
LQ: dict[str, Any] = {"prediction": "closed_loop", "terminal": "riccati"}
# UAVs, owned ones, settings: around the width of a vector, with and without each kind of output and
# row.
CASES: list[tuple[int, tuple[int, ...], dict[str, Any]]] = [
    (1, (0,), {"horizon": 1}),
    (2, (1,), {"horizon": 3, "separation": SeparationSection(minimum_m=1.5)}),
    (4, (0, 2), {"horizon": 7, **ALL_ROWS}),
    (4, (2,), {"horizon": 20, "tilt": TiltSection(limit_deg=20.0), **LQ}),
    (4, (0, 1, 2, 3), {"horizon": 5, **ALL_ROWS, **LQ}),
    (4, (1, 3), {"horizon": 9, "motor_lag_s": 0.03, **ALL_ROWS, **LQ}),
    (3, (0,), {"horizon": 6, "prediction": "closed_loop", "motor_lag_s": 0.03}),
    (4, (1,), {"horizon": 8, "linearisation": "along", **LQ}),
    (3, (1,), {"horizon": 20}),
]


def problem(
    case: tuple[int, tuple[int, ...], dict[str, Any]],
    seed: int = 1,
    one: Controller | None = None,
    size: float = SMALL,
) -> tuple[Controller, Prediction, QP, FeedbackLaw | None, QP]:
    """Return controller, prediction and QP by the kernels, control law, and the QP by the matrix products."""
    N, owned, options = case
    setup, settings = paper_setup() if N == 4 else ring_setup(N), ControllerSettings(**options)
    at, rng = situation(setup, settings, seed, size), np.random.default_rng(seed)
    one = one or Controller(setup.model, setup.hover, settings, owned)
    x = np.concatenate([at.x, 1.01 * at.u]) if settings.motor_lag_s else at.x
    X_ref = setup.x + 0.1 * rng.standard_normal((settings.horizon + 1, len(setup.x)))
    law = one.law(x, X_ref[:-1], 0.1 * rng.standard_normal(at.U.shape))
    end: CostToGo | None = one.end(x, X_ref[-1])
    linear = one.linearise(x, at.u)
    prediction = one.predict(linear, one.discretise(linear), at.U, law)
    assert isinstance(prediction, Prediction)
    qp = one.condense(linear, prediction, at.y_ref, law, end)
    plain = one.condense(linear, replace(prediction), at.y_ref, law, end)
    return one, prediction, qp, law, plain


@needs_kernels
@pytest.mark.usefixtures("vector_width")
@pytest.mark.parametrize("case", CASES, ids=str)
def test_kernels_are_the_matrix_products(
    case: tuple[int, tuple[int, ...], dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Prediction, Hessian, symmetric to the bit, gradient, bounds and rows."""
    _, prediction, qp, _, plain = problem(case)
    assert np.array_equal(qp.H, qp.H.T), "solvers read one triangle only"
    for name in ("H", "g", "A"):
        assert close(getattr(qp, name), getattr(plain, name), CANCELLED), name
    for name in ("lower", "upper", "row_lower", "row_upper"):
        one, other = getattr(qp, name), getattr(plain, name)
        assert np.array_equal(np.isfinite(one), np.isfinite(other))
        assert close(one[np.isfinite(one)], other[np.isfinite(other)], CANCELLED), name
    monkeypatch.setattr(native, "AVAILABLE", False)
    expected = problem(case)[1]
    for name in ("effect", "dX_free", "U_free", "U_all", "feedback", "dU_free"):
        assert close(getattr(prediction, name), getattr(expected, name), CANCELLED), name


@needs_kernels
def test_uavs_in_one_point_are_pushed_apart_by_the_kernels_too() -> None:
    """Two UAVs in one point have no direction: rows are those of the matrix products, finite and not zero."""
    one, _, _, _, _ = problem(CASES[1])
    setup = ring_setup(2)
    at = situation(setup, one.settings, 1, SMALL)
    linear = one.linearise(at.x, at.u)
    y = linear.model.y.copy()
    y[3:6] = y[:3]
    linear = msgspec.structs.replace(linear, model=replace(linear.model, y=y))
    prediction = one.predict(linear, one.discretise(linear), at.U, None)
    assert isinstance(prediction, Prediction)
    qp = one.condense(linear, prediction, at.y_ref)
    plain = one.condense(linear, replace(prediction), at.y_ref)
    distances = slice(len(qp.A) - one.settings.horizon, None)
    assert np.abs(qp.A[distances, :-1]).max(axis=1).all()
    assert close(qp.A, plain.A, CANCELLED)
    assert close(qp.row_lower[distances], plain.row_lower[distances], CANCELLED)


@pytest.mark.parametrize(
    ("prediction", "terminal"),
    [("open_loop", "riccati"), ("closed_loop", "multiple"), ("closed_loop", "riccati")],
)
def test_effort_of_the_others_counts_where_the_cost_to_go_has_it(
    prediction: PredictionName, terminal: Literal["multiple", "riccati"]
) -> None:
    """Others that answer by the law cost their effort before a cost-to-go, which has it too: (26), (36e)."""
    setup = paper_setup()
    settings = ControllerSettings(horizon=6, prediction=prediction, terminal=terminal)
    at = situation(setup, settings, 1, SMALL)
    one = Controller(setup.model, setup.hover, settings, (1,))
    law = one.law(at.x, np.tile(setup.x, (6, 1)), np.zeros_like(at.U))
    end = one.end(at.x, setup.x)
    linear = one.linearise(at.x, at.u)
    found = one.predict(linear, one.discretise(linear), at.U, law)
    assert isinstance(found, Prediction)
    qp = one.condense(linear, found, at.y_ref, law, end)
    plain = one.condense(linear, replace(found), at.y_ref, law, end)
    others = np.setdiff1d(np.arange(setup.system.m), one.own)
    scale = (settings.upper(1) - settings.lower(1)) / 2.0
    Q, R = one.cost.Q, one.cost.R

    def cost(z: Array) -> float:
        v = z.reshape(6, 4) * scale
        dX = found.dX_free[1:] + (stacked(found.effect) @ v.reshape(-1)).reshape(6, -1)
        errors = linear.model.y + dX @ linear.model.C.T - at.y_ref[1:]
        stages = errors**2 @ Q
        total = stages[:-1].sum() + (found.U_free + v - linear.u_target[one.own]) ** 2 @ R[
            one.own
        ] @ np.ones(6)
        if end is None:
            return float(total + settings.weights.terminal * stages[-1])
        total += np.sum((end.root @ (end.error + dX[-1])) ** 2) + 2.0 * end.slope @ dX[-1]
        if law is not None:
            U = found.U_all + convolve(found.feedback, v) - linear.u_target
            total += (U[1:, others] ** 2 @ R[others]).sum()
        return float(total)

    rng = np.random.default_rng(3)
    for _ in range(3):
        z = 0.1 * rng.standard_normal(24)
        expected = cost(z) - cost(np.zeros(24))
        for each in (qp, plain):
            found_cost = each.objective(z) - each.objective(np.zeros(24))
            assert found_cost == pytest.approx(expected, rel=1e-9)


@needs_kernels
@pytest.mark.parametrize("rows", [{}, ALL_ROWS], ids=["linear terms", "all rows"])
def test_what_is_known_of_the_step_before_changes_no_bit(rows: dict[str, Any]) -> None:
    """Along the control law, effects and Hessian are those at hover.

    Kept, they are the ones of a new controller.
    """
    terms = {"cost": (CostTerm(expression="omega1[0]", weight=0.1),)}
    case = 4, (0, 2), {"horizon": 7, "linearisation": "along", **LQ, **terms, **rows}
    one = problem(case)[0]
    for seed in (2, 3):
        (_, kept, qp, *_), (_, new, expected, *_) = problem(case, seed, one), problem(case, seed)
        for field in fields(QP):
            assert np.array_equal(getattr(qp, field.name), getattr(expected, field.name)), (
                field.name
            )
        for field in fields(Prediction):
            assert np.array_equal(getattr(kept, field.name), getattr(new, field.name)), field.name
        compiled = one._program.compiled
        assert compiled is not None
        assert compiled._problem.known == (not rows)


@pytest.mark.parametrize(
    ("gone", "sizes"),
    [((3,), (SMALL,)), ((), (STEEP,)), ((3,), (STEEP, SMALL))],
    ids=["another gain", "no trajectory", "a trajectory again"],
)
def test_nothing_is_left_of_a_step_with_another_law(
    gone: tuple[int, ...], sizes: tuple[float, ...]
) -> None:
    """After a death, or where (35a) has no trajectory, a step equals that of a new controller."""
    case = 4, (0, 2), {"horizon": 7, "linearisation": "along", **LQ, **ALL_ROWS}
    setup = paper_setup()
    used = problem(case)[0]
    new = Controller(setup.model, setup.hover, used.settings, used.owned)
    for one in (used, new) if gone else ():
        one.without(gone)
    for size in sizes[:-1]:
        problem(case, 2, used, size)
    found, expected = (problem(case, 3, one, sizes[-1]) for one in (used, new))
    for field in fields(Prediction):
        name = field.name
        assert np.array_equal(getattr(found[1], name), getattr(expected[1], name)), name
    for field in fields(QP):
        name = field.name
        assert np.array_equal(getattr(found[2], name), getattr(expected[2], name)), name


@needs_kernels
@pytest.mark.usefixtures("vector_width")
@pytest.mark.parametrize("w", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("size", [0.01, 10.0], ids=["within limits", "beyond limits"])
@pytest.mark.parametrize("case", [case for case in CASES if "prediction" in case[2]], ids=str)
def test_relaxed_plans_of_the_kernels(
    case: tuple[int, tuple[int, ...], dict[str, Any]], w: float, size: float
) -> None:
    """Inputs and corrections, with bounds and rates that hold and that do not, are those of the plain functions."""
    one, prediction, _, law, _ = problem(case)
    assert law is not None
    program = one._program
    z = size * np.random.default_rng(2).standard_normal(program.decision.size)
    for found, expected in zip(
        program.relaxed(prediction, law, z, w),
        program.relaxed(replace(prediction), law, z, w),
        strict=True,
    ):
        assert close(found, expected, CANCELLED)


@needs_kernels
def test_a_plan_is_of_the_law_given_and_stays() -> None:
    """Another law than that of the prediction counts, and a later plan does not change the one before, (36a)."""
    one, prediction, _, law, _ = problem(CASES[3])
    assert law is not None
    program = one._program
    assert program.compiled is not None
    assert program.compiled.follows(prediction, law), "no plan is that of the kernels"
    z = np.random.default_rng(2).standard_normal(program.decision.size)
    other = msgspec.structs.replace(law, c=law.c + 1.0)
    plans = [
        program.relaxed(prediction, of, factor * z, 0.5)
        for of in (law, other)
        for factor in (1.0, -1.0)
    ]
    plain = [
        program.relaxed(replace(prediction), of, factor * z, 0.5)
        for of in (law, other)
        for factor in (1.0, -1.0)
    ]
    for found, expected in zip(plans, plain, strict=True):
        for part, expected_part in zip(found, expected, strict=True):
            assert close(part, expected_part, CANCELLED)


@needs_kernels
@pytest.mark.parametrize("in_place", [False, True], ids=["another array", "in place"])
@pytest.mark.parametrize("which", ["A", "B", "K", "drift"])
def test_one_new_matrix_makes_a_new_prediction(which: str, *, in_place: bool) -> None:
    """The difference equation, or the gain, is new if one of its matrices is; another drift alone changes the rest."""
    one, _, _, law, _ = problem(CASES[7])
    assert law is not None
    compiled = one._program.compiled
    assert compiled is not None
    setup = paper_setup()
    at = situation(setup, one.settings, 2, SMALL)
    linear = one.linearise(at.x, at.u)
    hold = one.discretise(linear)
    matrices = {"A": hold.A.copy(), "B": hold.B.copy(), "K": law.K.copy()}
    if not in_place:
        frozen(*matrices.values())
    for is_second in (False, True):
        if is_second and which in matrices:
            if in_place:
                matrices[which] *= 1.5
            else:
                matrices[which] = 1.5 * matrices[which]
        drift = hold.f_d + 0.1 * is_second
        discrete = Discrete(A=matrices["A"], B=matrices["B"], f_d=drift)
        given = msgspec.structs.replace(law, K=matrices["K"])
        found, is_new = compiled.respond(linear, discrete, at.U, given, only_new=which in matrices)
        expected = predict(discrete, linear.u0, one.own, at.U, given)
        assert is_new == (not is_second or which in matrices or in_place)
        one.condense(linear, found, at.y_ref, given)
        for name in ("effect", "feedback") if which in matrices else ("effect", "dX_free", "U_all"):
            assert close(getattr(found, name), getattr(expected, name), CANCELLED), name


@needs_kernels
@pytest.mark.usefixtures("vector_width")
@pytest.mark.parametrize("seed", range(40))
def test_bounded_programs_have_their_solution(seed: int) -> None:
    """The kernel finds the optimum an interior-point method finds, whatever the bounds."""
    program = random_qp(seed)
    none, n = np.zeros(0), len(program.g)
    program = replace(program, A=np.zeros((0, n)), row_lower=none, row_upper=none)
    if seed % 2:  # one coordinate that has no choice, on either side of its optimum
        lower, upper = program.lower.copy(), program.upper.copy()
        lower[0] = upper[0] = solve_clarabel(program).z[0] + (seed % 4 - 2) / 2.0
        program = replace(program, lower=lower, upper=upper)
    expected, found = solve_clarabel(program), within_bounds(program)
    assert found is not None, "these are well conditioned: no circles"
    assert np.abs(found.z - expected.z).max() <= 1e-6 * max(1.0, np.abs(found.z).max())
    assert ((program.lower <= found.z) & (found.z <= program.upper)).all()
    assert residuals(program, found.z, found.bound_multipliers, none).worst <= 1e-9


def test_a_program_without_curvature_is_given_up() -> None:
    """A matrix that is not positive definite, or nan, is reported as a failure."""
    for H in (-np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan)):
        free = np.full(3, np.inf)
        qp = QP(
            H=H,
            g=np.ones(3),
            lower=-free,
            upper=free,
            A=np.zeros((0, 3)),
            row_lower=free[:0],
            row_upper=free[:0],
        )
        assert within_bounds(qp) is None


@pytest.mark.parametrize("seed", range(20))
def test_residuals_of_the_kernels(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the optimum, and anywhere else; what is not a number stays so, wherever it is."""
    program = random_qp(seed)
    answer = solve_clarabel(program)
    rng = np.random.default_rng(seed)
    for size in (0.0, 1e-3, 1.0):
        z = answer.z + size * rng.standard_normal(len(answer.z))
        pushed = answer.bound_multipliers + size * rng.standard_normal(len(z))
        rows = answer.row_multipliers + size * rng.standard_normal(len(program.A))
        found = residuals(program, z, pushed, rows)
        with monkeypatch.context() as plain:
            plain.setattr(native, "AVAILABLE", False)
            expected = residuals(program, z, pushed, rows)
        for name in ("stationarity", "primal", "complementarity"):
            assert getattr(found, name) == pytest.approx(
                getattr(expected, name), rel=1e-9, abs=1e-12
            )
    for at in (0, len(z) // 2, len(z) - 1):
        broken = answer.z.copy()
        broken[at] = np.nan
        assert (
            residuals(program, broken, answer.bound_multipliers, answer.row_multipliers).worst
            == np.inf
        )
