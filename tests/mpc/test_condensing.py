"""Condensed Hessian, gradient and rows against the paper's stacked matrices, and the responses against a loop."""

import numpy as np
import pytest

from model.arrays import Array
from model.discretisation import Discrete
from mpc import condensing
from mpc.prediction import free_response, open_loop, responses
from tests.support import naive

# Both sides are sums of the same products in another order: only rounding, relative to the largest entry.
ROUNDING = 1e-12

# (states, owned inputs, others' inputs, outputs, horizon): scalars, horizon 1 and 2, wide, tall, many steps.
SIZES = [(1, 1, 1, 1, 1), (3, 2, 1, 2, 1), (4, 1, 3, 5, 2), (2, 3, 2, 1, 3), (6, 2, 4, 3, 7), (5, 4, 4, 4, 20)]
SEEDS = [0, 1, 2]


class Random:
    """A random affine system with its weights."""

    def __init__(self, size: tuple[int, int, int, int, int], seed: int) -> None:
        self.n, self.m, self.others, self.p, self.steps = size
        rng = np.random.default_rng(seed)
        A = rng.standard_normal((self.n, self.n))
        # Powers neither explode nor vanish over the horizon, so that every block counts in the comparison.
        self.A = A / max(abs(np.linalg.eigvals(A)))
        self.B = rng.standard_normal((self.n, self.m))
        self.C = rng.standard_normal((self.p, self.n))
        self.Q = rng.uniform(0.0, 2.0, self.p)
        self.terminal = rng.uniform(0.0, 9.0)
        self.Q_f = self.terminal * self.Q
        self.rng = rng


@pytest.fixture(params=[(size, seed) for size in SIZES for seed in SEEDS], ids=str)
def system(request: pytest.FixtureRequest) -> Random:
    """One random system of each size and seed."""
    return Random(*request.param)


def close(left: Array, right: Array) -> bool:
    """Equal up to rounding relative to the largest entry."""
    scale = max(1.0, float(np.abs(right).max(initial=0.0)))
    return left.shape == right.shape and bool(np.abs(left - right).max(initial=0.0) <= ROUNDING * scale)


def test_hessian_is_the_stacked_product(system: Random) -> None:
    """The block-diagonal sums give (C-bar H)' Q-bar (C-bar H) of paper (16)-(17), terminal block included."""
    lifted = naive.stacked_output(system.C, system.steps) @ naive.stacked_input(system.A, system.B, system.steps)
    expected = lifted.T @ naive.stacked_weight(system.Q, system.Q_f, system.steps) @ lifted
    impulse = responses(system.A, system.B, np.zeros((system.steps, system.n)))[0]
    H = condensing.hessian(system.C @ impulse, system.Q, system.terminal)
    assert close(H, expected)
    assert np.array_equal(H, H.T), "solvers read one triangle only: both must agree to the bit"


def test_gradient_is_the_stacked_product(system: Random) -> None:
    """The diagonal sums give (C-bar H)' Q-bar e of paper (17), for any error e of the free response."""
    steps = system.steps
    error = system.rng.standard_normal((steps + 1, system.p))
    lifted = naive.stacked_output(system.C, steps) @ naive.stacked_input(system.A, system.B, steps)
    expected = lifted.T @ naive.stacked_weight(system.Q, system.Q_f, steps) @ error.reshape(-1)
    weighted = error[1:] * np.vstack([np.tile(system.Q, (steps - 1, 1)), system.Q_f])
    impulse = responses(system.A, system.B, np.zeros((steps, system.n)))[0]
    assert close(condensing.gradient(system.C @ impulse, weighted), expected)


def test_rows_are_the_stacked_matrix(system: Random) -> None:
    """Rows of a signal s = S x at steps 1..N_p are S-bar H of paper (16) without its first, zero block row."""
    stacked = naive.stacked_output(system.C, system.steps) @ naive.stacked_input(system.A, system.B, system.steps)
    impulse = responses(system.A, system.B, np.zeros((system.steps, system.n)))[0]
    assert not stacked[: system.p].any()
    assert close(condensing.rows(system.C @ impulse), stacked[system.p :])


def test_impulse_response_is_the_reaction_to_one_input(system: Random) -> None:
    """A^j B is the state j + 1 steps after a unit input, the first block column of H in paper (16)."""
    impulse = responses(system.A, system.B, np.zeros((system.steps, system.n)))[0]
    zero = np.zeros(system.n)
    for channel in range(system.m):
        dU = np.zeros((system.steps, system.m))
        dU[0, channel] = 1.0
        assert close(impulse[:, :, channel], naive.simulate(system.A, system.B, zero, dU)[1:])


def test_free_response_is_a_plain_loop(system: Random) -> None:
    """With a constant drive the response is F of paper (16); with a changing one it is the recursion (14)."""
    drift = system.rng.standard_normal(system.n)
    constant = free_response(system.A, np.tile(drift, (system.steps, 1)))
    assert close(constant.reshape(-1), naive.stacked_drift(system.A, drift, system.steps))
    W = system.rng.standard_normal((system.steps, system.n))
    changing = naive.simulate(system.A, np.eye(system.n), np.zeros(system.n), W)
    assert close(free_response(system.A, W), changing)


def test_prediction_splits_owned_from_announced(system: Random) -> None:
    """dX = F + G dx(k) + H_i dU_i + H-bar_i dU-bar_i, paper (24), with dx(k) = 0 and any choice of owned inputs."""
    rng, steps, total = system.rng, system.steps, system.m + system.others
    B, f_d = rng.standard_normal((system.n, total)), rng.standard_normal(system.n)
    u0, U = rng.standard_normal(total), rng.standard_normal((steps, total))
    own = np.sort(rng.permutation(total)[: system.m])
    rest = np.setdiff1d(np.arange(total), own)
    v = rng.standard_normal((steps, system.m))
    prediction = open_loop(Discrete(A=system.A, B=B, f_d=f_d), u0, own, U)

    expected = (
        naive.stacked_drift(system.A, f_d, steps)
        + naive.stacked_state(system.A, steps) @ np.zeros(system.n)
        + naive.stacked_input(system.A, B[:, own], steps) @ v.reshape(-1)
        + naive.stacked_input(system.A, B[:, rest], steps) @ (U - u0)[:, rest].reshape(-1)
    )
    decided = (condensing.rows(prediction.impulse) @ v.reshape(-1)).reshape(steps, system.n)
    dX = prediction.dX_free + np.vstack([np.zeros(system.n), decided])
    assert close(dX.reshape(-1), expected)
    assert np.array_equal(prediction.U_free, np.tile(u0[own], (steps, 1)))


def test_prediction_does_not_read_the_owned_plan() -> None:
    """The owned columns of the announced inputs are the decision itself, so their content changes nothing."""
    system = Random((4, 2, 2, 3, 5), seed=7)
    rng = system.rng
    discrete = Discrete(A=system.A, B=rng.standard_normal((4, 4)), f_d=rng.standard_normal(4))
    u0, U, own = rng.standard_normal(4), rng.standard_normal((5, 4)), np.array([1, 3])
    other = U.copy()
    other[:, own] += 5.0
    before = U.copy()
    first, second = open_loop(discrete, u0, own, U), open_loop(discrete, u0, own, other)
    assert np.array_equal(first.dX_free, second.dX_free)
    assert np.array_equal(U, before), "the announced inputs belong to the caller"
