"""Zero-order hold against the matrix exponential, in closed form, and by the properties of a flow."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.support import naive
from tests.support.random_systems import random_input, random_state, random_system
from transport.model.arrays import Array, ShapeError
from transport.model.linear.discretisation import euler, zero_order_hold
from transport.model.linear.linearisation import Linearisation, Model

PERIODS_S = [0.001, 0.02, 0.05, 0.3, 1.0, 2.0]
# Both sides round; relative to the largest entry, which grows to 1e6 over 2 s far from equilibrium.
# Measured 1e-14.
EXPONENTIAL_TOLERANCE = 1e-12
# Closed forms of 2 x 2 systems.
CLOSED_FORM_TOLERANCE = 1e-14


@cache
def random_linearisation(N: int, draw: int = 0) -> Linearisation:
    """Return that of a random system, far from equilibrium."""
    rng = np.random.default_rng(1500 + 10 * N + draw)
    return Model(random_system(rng, N)).linearise(random_state(rng, N), random_input(rng, N))


def plain(A_c: Array, B_c: Array, f: Array) -> Linearisation:
    """A linearisation without outputs: discretising must not look at them."""
    n = len(A_c)
    return Linearisation.of(f, A_c, B_c, np.zeros(1), np.zeros((1, n)))


def deviation(value: Array, expected: Array) -> float:
    """Largest difference relative to the largest entry."""
    assert value.shape == expected.shape
    return float(np.abs(value - expected).max() / np.abs(expected).max())


@pytest.mark.parametrize("period_s", PERIODS_S)
@pytest.mark.parametrize("N", [1, 2, 4, 8])
def test_equals_the_exponential_of_the_augmented_matrix(N: int, period_s: float) -> None:
    """A, B and f_d of paper (14) are exact for the linear system of paper (13), short and long periods alike."""
    for draw in range(3):
        linear = random_linearisation(N, draw)
        own, expected = zero_order_hold(linear, period_s), naive.exact_hold(linear, period_s)
        for found, exact in zip((own.A, own.B, own.f_d), expected, strict=True):
            assert deviation(found, exact) < EXPONENTIAL_TOLERANCE


@pytest.mark.parametrize("period_s", [0.05, 2.0])
@pytest.mark.parametrize("N", [1, 4])
def test_another_drift_with_known_matrices_is_the_same_hold(N: int, period_s: float) -> None:
    """Taking A and B from the step before changes no bit, short periods and halved ones alike."""
    linear = random_linearisation(N)
    other = replace(linear, f=random_linearisation(N, 1).f)
    known = zero_order_hold(linear, period_s)
    own, expected = zero_order_hold(other, period_s, known), zero_order_hold(other, period_s)
    for name in ("A", "B", "f_d"):
        assert getattr(own, name).tobytes() == getattr(expected, name).tobytes()


def test_double_integrator_in_closed_form() -> None:
    """A = [1 T; 0 1], B = [T^2 / 2; T]: the series ends where the nilpotent matrix does."""
    T = 0.7
    own = zero_order_hold(
        plain(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([0.0, 2.0])), T
    )
    assert np.abs(own.A - np.array([[1.0, T], [0.0, 1.0]])).max() <= CLOSED_FORM_TOLERANCE
    assert np.abs(own.B - np.array([[T**2 / 2.0], [T]])).max() <= CLOSED_FORM_TOLERANCE
    assert np.abs(own.f_d - np.array([T**2, 2.0 * T])).max() <= CLOSED_FORM_TOLERANCE


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200, 1e9])
def test_numbers_that_are_not_finite_are_refused(bad: float) -> None:
    """A linearisation at a singular state raises and names A_c, instead of cutting the period for ever."""
    with pytest.raises(ShapeError, match="A_c: expected finite numbers"):
        zero_order_hold(
            plain(np.array([[0.0, bad], [bad, 0.0]]), np.zeros((2, 1)), np.zeros(2)), 0.05
        )


@pytest.mark.parametrize("N", [2, 4])
def test_euler_is_the_hold_to_second_order(N: int) -> None:
    """The error of one step of Euler's method is T_s^2 / 2 A_c [A_c B_c f], and higher orders."""
    linear, period_s = random_linearisation(N), 1e-3
    half = 0.5 * period_s**2 * linear.A_c
    own, exact = euler(linear, period_s), zero_order_hold(linear, period_s)
    pairs = (
        (own.A, exact.A, linear.A_c),
        (own.B, exact.B, linear.B_c),
        (own.f_d, exact.f_d, linear.f),
    )
    for found, right, factor in pairs:
        assert deviation(right - found, half @ factor) < 0.02
