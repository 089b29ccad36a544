"""The compiled loops of prediction, condensing and solving against their twins in Python."""

from dataclasses import replace

import numpy as np
import pytest

from model import native
from model.arrays import Array
from mpc import bounded, condensing, qp
from mpc.prediction import _responses, free_response, responses
from mpc.solvers import solve_clarabel
from tests.support import naive
from tests.support.programs import random_qp

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


def test_responses_are_their_twin(size: tuple[int, int, int, int]) -> None:
    """Impulse and free response, and the free response alone."""
    n, m, _, steps = size
    rng = np.random.default_rng(n)
    A = np.where(rng.random((n, n)) < 0.6, rng.standard_normal((n, n)), 0.0) / n
    B, W = rng.standard_normal((n, m)), rng.standard_normal((steps, n))
    for found, expected in zip(responses(A, B, W), _responses(A, B, W), strict=True):
        assert close(found, expected)
    assert close(free_response(A, W), naive.simulate(A, np.eye(n), np.zeros(n), W))


def test_work_space_stays() -> None:
    """Work space of one size is not freed or reused when other sizes follow."""
    rng = np.random.default_rng(0)

    def problem(n: int) -> tuple[Array, Array, Array]:
        return rng.standard_normal((n, n)) / n, rng.standard_normal((n, 2)), rng.standard_normal((3, n))

    often = problem(100)
    expected = _responses(*often)
    for n in range(1, 300):
        responses(*problem(n))
        for one, other in zip(responses(*often), expected, strict=True):
            assert close(one, other)


def test_condensing_is_its_twin(size: tuple[int, int, int, int]) -> None:
    """Hessian, symmetric to the bit, and gradient, in a program that has slacks behind the decisions, untouched."""
    _, m, p, steps = size
    rng = np.random.default_rng(p)
    S, weighted, Q = rng.standard_normal((steps, p, m)), rng.standard_normal((steps, p)), rng.random(p)
    D = steps * m
    H, g = np.full((D + 2, D + 2), 7.0), np.full(D + 2, 7.0)
    condensing.condense(S, Q, 3.0, weighted, H, g)
    assert close(H[:D, :D], condensing.hessian(S, Q, 3.0))
    assert np.array_equal(H[:D, :D], H[:D, :D].T)
    assert close(g[:D], condensing.gradient(S, weighted))
    assert (H[D:] == 7.0).all()
    assert (H[:, D:] == 7.0).all()
    assert (g[D:] == 7.0).all()


def test_rows_are_their_twin(size: tuple[int, int, int, int]) -> None:
    """The block-Toeplitz matrix, in the middle of others' rows and columns."""
    _, m, p, steps = size
    S = np.random.default_rng(m).standard_normal((steps, p, m))
    A = np.zeros((steps * p + 3, steps * m + 2))
    A[:, -2:], A[:2], A[-1:] = 7.0, 7.0, 7.0
    condensing.fill(S, A[2:-1])
    assert np.array_equal(A[2:-1, :-2], condensing.rows(S))
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
