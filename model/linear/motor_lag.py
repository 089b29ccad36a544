"""First-order lag of the motors.

The actual inputs a follow the commanded inputs u by a' = (u - a) / lambda, with lambda the lag.
Two held inputs per step have the mean and first moment of a: a Magnus method of order 4 (Blanes,
Moan 2006). With commanded body rates, a is the command that would give the present angular
acceleration at once, a = omega + omega' / K, and a' has omega' beside the lag.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from transport.model.arrays import Array, padded
from transport.model.kernels.sparse_pattern import NAMES, Pattern
from transport.model.linear.linearisation import Jacobians, Linearisation, Model
from transport.model.state import INPUTS, OMEGA, PAYLOAD, PER_UAV


@dataclass(frozen=True, slots=True, kw_only=True)
class Period:
    """A time of constant commands, as it is integrated."""

    duration_s: float
    steps: int  # of equal length, >= 1
    lag_s: float = 0.0  # of the motors


def decay(lag_s: float, duration_s: float) -> float:
    """Return the share of a deviation from a held command that is left after a duration, s.

    0 without lag.
    """
    return math.exp(-duration_s / lag_s) if lag_s > 0.0 else 0.0


@lru_cache
def _deviations(lag_s: float, step_s: float) -> tuple[float, float]:
    """Return the deviations of two inputs, held for half a step each, that stand for exp(-t / lag).

    Their mean and first moment are those of the exponential. Source: docs/equations.md (54).
    """
    # r = lambda / h, q = exp(-h / lambda)
    r = lag_s / step_s
    q = decay(lag_s, step_s)
    # mu = r (1 - q), the mean.
    mean = r * (1.0 - q)
    # nu = 4 r^2 (1 - q) - 2 r (1 + q): four times the first moment about the middle, over h^2.
    moment = 4.0 * (r**2 * (1.0 - q) - r * (1.0 + q) / 2.0)
    return mean - moment, mean + moment


def two_held_inputs(
    a: Array, u: Array, lag_s: float, step_s: float
) -> tuple[tuple[Array, Array], Array]:
    """Return two inputs, held for half a step each, and the actual inputs at the end.

    The two stand for the actual inputs during the step.

    a, u: actual and commanded inputs at the beginning of the step, (m,) each.
    Source: docs/equations.md (54).
    """
    deviation = a - u
    first, second = _deviations(lag_s, step_s)
    inputs = u + first * deviation, u + second * deviation
    return inputs, u + decay(lag_s, step_s) * deviation


@lru_cache
def shares(lag_s: float, step_s: float, gains: tuple[float, ...] | None, uavs: int) -> Array:
    """Return shares left of deviations in two held inputs and at the end of a step, (3, 2, m).

    First axis: first input, second input, end; second axis: deviation of the actual inputs, of the
    body rates. Source: docs/equations.md (54), (58a).
    """
    shares_left = np.zeros((3, 2, INPUTS))
    first, second = _deviations(lag_s, step_s)
    shares_left[0, 0] = first
    shares_left[1, 0] = second
    shares_left[2, 0] = decay(lag_s, step_s)
    for axis, gain in enumerate(gains or (), start=1):
        shares_left[:, :, axis] = _rate_shares(lag_s, step_s, gain)
    return np.tile(shares_left, uavs)


def _rate_shares(lag_s: float, step_s: float, gain: float) -> Array:
    """Return the shares of one commanded body rate, (3, 2).

    z' = M z of z = [a, rate] under a zero command. Source: docs/equations.md (58a).
    """
    from scipy.linalg import expm  # 0.3 s at start; only a lag inside an inner loop needs it

    M = np.array([[gain - 1.0 / lag_s, -gain], [gain, -gain]])
    # z(h) = e^(M h) z(0); its integral over the step is M^-1 (e^(M h) - I) z(0).
    end = expm(M * step_s)
    area = np.linalg.solve(M, end - np.eye(2))

    # Mean and first moment of a, as of the exponential in (54), with
    # int_0^h t z dt = M^-1 (h z(h) - int_0^h z dt).
    mean = area[0] / step_s
    moment = 4.0 * (np.linalg.solve(M, step_s * end - area)[0] / step_s**2 - mean / 2.0)
    return np.array([mean - moment, mean + moment, end[0]])


def rate_places(m: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return the positions of commanded body rates in u, of m inputs, and of the rates in x."""
    uavs, axes = np.divmod(np.arange(3 * m // INPUTS), 3)
    in_inputs = INPUTS * uavs + 1 + axes
    in_states = PAYLOAD + PER_UAV * uavs + OMEGA.start + axes
    return in_inputs, in_states


def integrate(
    model: Model, z: Array, u: Array, period: Period, forces: Array | None = None
) -> Array:
    """Return x or, with lag, [x, a] after constant commands.

    With lag the order is 4. Source: docs/equations.md (54), (58a).
    """
    if period.lag_s == 0.0:
        return model.advance(z, u, period.duration_s, period.steps, forces=forces)

    x = z[: model.system.n]
    a = z[model.system.n :]
    step_s = period.duration_s / period.steps
    for _ in range(period.steps):
        (first, second), a = _held_inputs(model, x, a, u, period.lag_s, step_s)
        for half in (first, second):
            x = model.advance(x, half, step_s / 2.0, 1, forces=forces)
    return np.concatenate([x, a])


def _held_inputs(
    model: Model, x: Array, a: Array, u: Array, lag_s: float, step_s: float
) -> tuple[tuple[Array, Array], Array]:
    """Return two held inputs that stand for the actual ones, and these at the end of a step."""
    gains = model.system.rate_gains
    if gains is None:
        return two_held_inputs(a, u, lag_s, step_s)

    in_inputs, in_states = rate_places(len(u))
    rates = np.zeros_like(u)
    rates[in_inputs] = x[in_states]

    # u + s_a (a - u) + s_omega (omega - u); s_omega = 0 for thrusts.
    shares_left = shares(lag_s, step_s, tuple(gains.tolist()), model.system.N)
    of_actual = shares_left[:, 0]
    of_rates = shares_left[:, 1]
    first, second, end = u + of_actual * (a - u) + of_rates * (rates - u)
    return (first, second), end


@lru_cache(64)
def _pattern_with_lag(pattern: Pattern, rates: bool) -> tuple[Pattern, npt.NDArray[np.intp]]:
    """Return the pattern of a system [x, a] with motors, and the order of its entries.

    The factors are those of A_c = X + P V_x and B_c = U + P V_u, and C (`model/kernels/sparse_pattern.py`); those
    of the system with motors are marked by ':

        X' = [[X, U], [A_ax, A_aa]],    U' = [[0], [1/lambda]],
        P' = [[P], [0]],    V_x' = [V_x, V_u],    V_u' = 0,    C' = [C, 0]

    A_aa = -1/lambda and A_ax = 0. With commanded body rates A_aa = -1/lambda + K, and A_ax repeats
    the body rates' rows of X. Entries are taken from those of the system without motors, followed
    by the diagonals of A_aa and 1/lambda, (m,) each. Source: docs/equations.md (15b), (55), (58a).
    """
    factors = _factors_with_lag(pattern, rates)
    numbers = np.concatenate([factor[factor > 0.0] for factor in factors])  # from 1; some twice
    order = numbers.astype(np.intp) - 1
    return Pattern.of(factors), order


def _factors_with_lag(pattern: Pattern, rates: bool) -> list[Array]:
    """Return the factors of a system with motors, with numbers of entries in place of values.

    `Pattern.numbered` counts from 1: a 0 in a factor is no entry.
    """
    X, U, P, V_x, V_u, C = map(pattern.numbered, NAMES)
    n, m = U.shape

    # Numbers of the diagonals of A_aa and of 1/lambda: they follow those of the pattern.
    first = len(pattern.index) + 1.0
    on_itself = np.diag(first + np.arange(m))
    on_command = np.diag(first + np.arange(m, 2 * m))

    by_state = np.zeros((m, n))
    if rates:
        in_inputs, in_states = rate_places(m)
        by_state[in_inputs] = X[in_states]
    return [
        np.block([[X, U], [by_state, on_itself]]),
        np.vstack([np.zeros((n, m)), on_command]),
        np.vstack([P, np.zeros((m, P.shape[1]))]),
        np.hstack([V_x, V_u]),
        0.0 * V_u,
        padded(C, n + m),
    ]


def with_lag(
    linear: Linearisation, a: Array, u: Array, lag_s: float, rates: bool = False
) -> Linearisation:
    """Return the expansion of [x, a] and the command u, from that of x and a.

    a' = (u - a) / lambda, with commanded body rates + omega'.
    Source: docs/equations.md (55), (58a).
    """
    without_lag = linear.jacobians
    rate = np.full(len(a), 1.0 / lag_s)
    on_itself = -rate
    moving = (u - a) / lag_s

    if rates:
        in_inputs, in_states = rate_places(len(a))
        U = without_lag.pattern.dense(without_lag.values, "U")
        on_itself[in_inputs] += U[in_states, in_inputs]
        moving[in_inputs] += linear.f[in_states]

    pattern, order = _pattern_with_lag(without_lag.pattern, rates)
    values = np.concatenate([without_lag.values, on_itself, rate])[order]
    return Linearisation(
        f=np.concatenate([linear.f, moving]),
        y=linear.y,
        jacobians=Jacobians(pattern=pattern, values=values),
    )
