"""General Kalman filter on two states, position and velocity, with closed forms."""

import numpy as np
import pytest

from transport.agent.estimation.filter import kalman
from transport.agent.estimation.filter.kalman import Observation
from transport.model.arrays import Array

PERIOD_S = 0.1
SENSOR = 0.3  # standard deviation of a measured position, m
A = np.array([[1.0, PERIOD_S], [0.0, 1.0]])
H = np.array([[1.0, 0.0]])
R = np.array([SENSOR**2])

# Standard deviation before the first measurement that stands for no information, m and m/s. Its
# part in later covariances is 1e-9; the rounding of P = 1e10 after the first correction is larger.
NO_INFORMATION = 1e5
ROUNDING = 1e-5

SETTLED = 500  # ticks after which the gain has settled to rounding
STEADY = 1e-9


def observed(error: float) -> Observation:
    """Return a measured position by its deviation from the estimate."""
    return Observation(error=np.array([error]), H=H, R=R)


def filtered(positions: Array, P: Array, Q: Array) -> tuple[Array, Array]:
    """Return state and covariance after measurements of the position, one a tick, from zero."""
    x = np.zeros(2)
    for k, position in enumerate(positions):
        if k:
            x = A @ x
            P = kalman.predict(P, A, Q)
        observation = observed(position - x[0])
        correction = kalman.correct(P, observation)
        x = x + correction.step
        P = kalman.corrected(P, correction.G, observation)
    return x, P


@pytest.mark.parametrize("count", [2, 3, 10, 40])
def test_without_noise_it_is_the_straight_line_of_least_squares(count: int) -> None:
    """At constant velocity, state and covariance are those of a fitted line at its end.

    With n measurements of variance R, T apart: var(position) = 2 (2 n - 1) R / (n (n + 1)),
    cov = 6 R / (T n (n + 1)), var(velocity) = 12 R / (T^2 n (n^2 - 1)).
    """
    rng = np.random.default_rng(count)
    times_s = PERIOD_S * np.arange(count)
    positions = 1.0 + 2.0 * times_s + SENSOR * rng.standard_normal(count)

    x, P = filtered(positions, NO_INFORMATION**2 * np.eye(2), np.zeros((2, 2)))

    velocity, start = np.polyfit(times_s, positions, 1)
    np.testing.assert_allclose(x, [start + velocity * times_s[-1], velocity], rtol=ROUNDING)
    n = float(count)
    variance = SENSOR**2 / (n * (n + 1.0))
    covariance = 6.0 * variance / PERIOD_S
    expected = [
        [2.0 * (2.0 * n - 1.0) * variance, covariance],
        [covariance, 12.0 * variance / (PERIOD_S**2 * (n - 1.0))],
    ]
    np.testing.assert_allclose(P, expected, rtol=ROUNDING)


@pytest.mark.parametrize("acceleration", [0.1, 5.0, 200.0])
def test_with_noise_the_gain_settles_to_that_of_the_tracking_index(acceleration: float) -> None:
    """Under white acceleration the steady gain is that of the alpha-beta filter (Kalata 1984).

    With the tracking index l = T^2 sigma_a / sigma_z and r = (4 + l - (8 l + l^2)^(1/2)) / 4:
    alpha = 1 - r^2, beta = 2 (2 - alpha) - 4 (1 - alpha)^(1/2), G = [alpha, beta / T].
    """
    by_acceleration = np.array([PERIOD_S**2 / 2.0, PERIOD_S])
    Q = acceleration**2 * np.outer(by_acceleration, by_acceleration)

    _, P = filtered(np.zeros(SETTLED), np.eye(2), Q)
    G = kalman.correct(kalman.predict(P, A, Q), observed(0.0)).G

    index = PERIOD_S**2 * acceleration / SENSOR
    r = (4.0 + index - np.sqrt(8.0 * index + index**2)) / 4.0
    alpha = 1.0 - r**2
    beta = 2.0 * (2.0 - alpha) - 4.0 * np.sqrt(1.0 - alpha)
    np.testing.assert_allclose(G[:, 0], [alpha, beta / PERIOD_S], rtol=STEADY)


def test_squared_innovation_is_in_units_of_its_covariance() -> None:
    """An innovation of two of its deviations counts four, whatever the covariance."""
    P = np.array([[0.5, 0.1], [0.1, 0.2]])
    deviation = np.sqrt(P[0, 0] + SENSOR**2)
    assert kalman.correct(P, observed(2.0 * deviation)).squared_error == pytest.approx(4.0)


def test_covariance_is_exact_for_any_gain() -> None:
    """With a gain that is not optimal the covariance is that of the errors that it leaves.

    The error after the correction is (1 - g) of the prediction's and g of the sensor's.
    """
    P = np.diag([0.5, 0.2])
    gain = 0.25
    G = np.array([[gain], [0.0]])

    after = kalman.corrected(P, G, observed(0.0))

    np.testing.assert_allclose(after[0, 0], (1.0 - gain) ** 2 * 0.5 + gain**2 * SENSOR**2)
    np.testing.assert_allclose(after[1, 1], 0.2)
    assert (
        after[0, 0] > kalman.corrected(P, kalman.correct(P, observed(0.0)).G, observed(0.0))[0, 0]
    )


def test_exact_sensors_leave_no_negative_variance() -> None:
    """After a thousand nearly exact measurements the covariance is positive semidefinite."""
    exact = Observation(error=np.zeros(1), H=H, R=np.array([1e-18]))
    P = np.diag([1e4, 1e4])
    for _ in range(1000):
        P = kalman.predict(P, A, np.zeros((2, 2)))
        P = kalman.corrected(P, kalman.correct(P, exact).G, exact)
    np.testing.assert_array_equal(P, P.T)
    assert np.linalg.eigvalsh(P).min() >= 0.0
