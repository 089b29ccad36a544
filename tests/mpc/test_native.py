"""The compiled loops of prediction, condensing and solving against their twins in Python."""

from dataclasses import replace

import numpy as np
import pytest
from mpc.objective import _condense
from mpc.rows.interface import StepData

from model import native
from model.arrays import Array
from model.discretisation import Discrete
from model.linearisation import Linearisation
from model.native import Places
from mpc import bounded, condensing, qp
from mpc.plan import _relax
from mpc.prediction import Linear, _respond, open_loop, respond
from mpc.rows import _distances, _plain_distances, pairs_of
from mpc.solvers import solve_clarabel
from tests.support.programs import random_qp
from tests.support.systems import paper_setup

pytestmark = pytest.mark.skipif(not native.AVAILABLE, reason="no compiled kernels: no C compiler, or switched off")

ROUNDING = 1e-12

# (states, inputs, outputs, horizon), around the width of a vector.
SIZES = [(1, 1, 1, 1), (3, 2, 2, 1), (7, 4, 5, 2), (8, 7, 8, 3), (9, 8, 3, 9), (60, 4, 19, 20), (36, 16, 19, 10)]


@pytest.fixture(params=SIZES, ids=str)
def size(request: pytest.FixtureRequest) -> tuple[int, int, int, int]:
    """Sizes of one random problem."""
    size: tuple[int, int, int, int] = request.param
    return size


def close(one: Array, other: Array) -> bool:
    """Equal up to rounding relative to the largest entry."""
    scale = max(1.0, float(np.abs(other).max(initial=0.0)))
    return one.shape == other.shape and bool(np.abs(one - other).max(initial=0.0) <= ROUNDING * scale)


def discrete_of(n: int, m: int, rng: np.random.Generator) -> Discrete:
    """A random difference equation with some zeros."""
    A = np.where(rng.random((n, n)) < 0.6, rng.standard_normal((n, n)), 0.0) / n
    return Discrete(A=A, B=rng.standard_normal((n, m)), f_d=rng.standard_normal(n))


@pytest.mark.parametrize("fed_back", [False, True])
def test_predictions_are_their_twin(size: tuple[int, int, int, int], fed_back: bool) -> None:
    """Effect of the decision and free response, on the states and through the gain on the inputs."""
    n, m, others, steps = size
    rng = np.random.default_rng(n)
    discrete, own = discrete_of(n, m + others, rng), np.sort(rng.permutation(m + others)[:m])
    K = rng.standard_normal((m + others, n)) / n if fed_back else None
    drive = rng.standard_normal((steps, m + others))
    found, expected = respond(discrete, own, K, drive), _respond(discrete, own, K, drive)
    for one, other in zip(found, expected, strict=True):
        assert close(one, other)


def test_work_space_stays() -> None:
    """Work space of one size is not freed or reused when other sizes follow."""
    rng = np.random.default_rng(0)

    def problem(n: int) -> tuple[Discrete, Places, Array, Array]:
        own = np.array([1])
        return discrete_of(n, 3, rng), own, rng.standard_normal((3, n)) / n, rng.standard_normal((3, 3))

    often = problem(100)
    expected = _respond(*often)
    for n in range(1, 300):
        respond(*problem(n))
        for one, other in zip(respond(*often), expected, strict=True):
            assert close(one, other)


@pytest.mark.parametrize("end", [False, True])
@pytest.mark.parametrize("terms", [0, 2])
def test_condensing_is_its_twin(size: tuple[int, int, int, int], end: bool, terms: int) -> None:
    """Hessian, symmetric to the bit, gradient, effect and free outputs, with slacks behind the decisions."""
    n, m, p, steps = size
    rng = np.random.default_rng(p)
    inputs, rank = m + 3, n // 2 + 1 if end else 0
    random = rng.standard_normal
    linear = Linearisation.of(random(n), random((n, n)), random((n, inputs)), random(p), random((p, n)))
    chosen = np.sort(rng.permutation(p)[: max(1, p - 1)])
    own = np.sort(rng.permutation(inputs)[:m])
    answering = np.setdiff1d(np.arange(inputs), own)[: 2 if end else 0]
    arguments = (
        linear, chosen, answering, own, 0.0 if end else 3.0, random((steps + 1, p)), random((terms, n)), random(terms),
        random((n, steps, m)), random((inputs, steps, m)), random((steps + 1, n)), random((steps, inputs)),
        random(inputs), rng.random(len(chosen) + terms + len(answering)), rng.random(m), rng.random(m),
        random((rank, n)), random(n), random(n), rng.random(2),
    )  # fmt: skip
    found, expected = native.condense(*arguments), _condense(*arguments)
    assert np.array_equal(found[0], found[0].T)
    for one, other in zip(found, expected, strict=True):
        assert close(one, other)


@pytest.mark.parametrize("w", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("tight", [False, True])
def test_relaxation_is_its_twin(size: tuple[int, int, int, int], w: float, tight: bool) -> None:
    """Inputs and corrections, with bounds and rates that hold and that do not."""
    _, m, others, steps = size
    rng = np.random.default_rng(m)
    random, all_inputs = rng.standard_normal, m + others
    own = np.sort(rng.permutation(all_inputs)[:m])
    most = np.full(m, 0.5 if tight else 1e3)
    arguments = (
        own, random(steps * m), rng.random(m), random((steps, m)), random((steps, all_inputs)),
        random((steps, all_inputs)), random((steps, all_inputs)), random((all_inputs, steps, m)) / (steps * m), w,
        -most, most, most / 2.0,
    )  # fmt: skip
    for one, other in zip(native.relax(*arguments), _relax(*arguments), strict=True):
        assert close(one, other)


@pytest.mark.parametrize("together", [False, True])
def test_distances_are_their_twin(together: bool) -> None:
    """Effect on the distances of pairs, and these without decision; also of two UAVs in one point."""
    setup, rng = paper_setup(), np.random.default_rng(1)
    linear = setup.model.linearise(setup.hover.x, setup.hover.u)
    if together:
        linear.y[3:6] = linear.y[:3]
    at = Linear(x0=setup.hover.x, u0=setup.hover.u, model=linear, u_target=setup.hover.u)
    prediction = open_loop(discrete_of(60, 16, rng), setup.hover.u, np.arange(4), rng.standard_normal((6, 16)))
    step = StepData(
        linear=at,
        prediction=prediction,
        positions=rng.standard_normal((6, 19)),
        position_effect=rng.standard_normal((19, 6, 4)),
        U=rng.standard_normal((6, 16)),
    )
    pairs = pairs_of(4, (0, 2))
    for one, other in zip(_distances(pairs, step), _plain_distances(pairs, step), strict=True):
        assert close(one, other)


def test_rows_are_their_twin(size: tuple[int, int, int, int]) -> None:
    """The block-Toeplitz matrix, in the middle of others' rows and columns."""
    _, m, p, steps = size
    S = np.random.default_rng(m).standard_normal((p, steps, m))
    A = np.zeros((steps * p + 3, steps * m + 2))
    A[:, -2:], A[:2], A[-1:] = 7.0, 7.0, 7.0
    condensing.fill(S, A[2:-1])
    assert np.array_equal(A[2:-1, :-2], condensing.rows(S.transpose(1, 0, 2)))
    assert (A[:, -2:] == 7.0).all()
    assert (A[:2] == 7.0).all()
    assert (A[-1:] == 7.0).all()


@pytest.mark.parametrize("seed", range(60))
def test_bounded_programs_have_their_solution(seed: int) -> None:
    """Both twins find the optimum an interior-point method finds, with bounds that hold, do not, or are not there."""
    program = random_qp(seed)
    n = len(program.g)
    none = np.zeros(0)
    program = replace(program, A=np.zeros((0, n)), row_lower=none, row_upper=none)
    expected = solve_clarabel(program)
    for solve in (bounded.solve, bounded._solve):
        z, multipliers, guesses = solve(program.H, program.g, program.lower, program.upper)
        assert guesses > 0, "these are well conditioned: no circles"
        assert np.abs(z - expected.z).max() <= 1e-6 * max(1.0, np.abs(z).max())
        assert (program.lower <= z).all()
        assert (z <= program.upper).all()
        assert qp.residuals(program, z, multipliers, none).worst <= 1e-9


def test_a_program_without_curvature_is_given_up() -> None:
    """A matrix that is not positive definite, or nan, is reported as a failure."""
    for H in (-np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan)):
        for solve in (bounded.solve, bounded._solve):
            assert solve(H, np.ones(3), np.full(3, -np.inf), np.full(3, np.inf))[2] == 0


@pytest.mark.parametrize("seed", range(20))
def test_residuals_are_their_twin(seed: int) -> None:
    """At the optimum, and anywhere else; what is not a number stays so, wherever it is."""
    program = random_qp(seed)
    answer = solve_clarabel(program)
    rng = np.random.default_rng(seed)
    for size in (0.0, 1e-3, 1.0):
        z = answer.z + size * rng.standard_normal(len(answer.z))
        pushed = answer.bound_multipliers + size * rng.standard_normal(len(z))
        rows = answer.row_multipliers + size * rng.standard_normal(len(program.A))
        found, expected = qp.residuals(program, z, pushed, rows), qp._residuals(program, z, pushed, rows)
        for one, other in (
            (found.stationarity, expected.stationarity),
            (found.primal, expected.primal),
            (found.complementarity, expected.complementarity),
        ):
            assert one == pytest.approx(other, rel=1e-9, abs=1e-12)
    for at in (0, len(z) // 2, len(z) - 1):
        broken = answer.z.copy()
        broken[at] = np.nan
        assert qp.residuals(program, broken, answer.bound_multipliers, answer.row_multipliers).worst == np.inf
