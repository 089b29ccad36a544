"""First-order lag of the motors.

The actual inputs a follow the commanded inputs u by a' = (u - a) / lag.

Two held inputs per step have the mean and first moment of a: a Magnus method of order 4 (Blanes,
Moan 2006). With commanded body rates a is the command that would give the present angular
acceleration at once, omega + omega' / K.
"""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from transport.model.arrays import Array, padded
from transport.model.linearisation import NAMES, Linearisation, Model, Pattern
from transport.model.state import INPUTS, OMEGA, PAYLOAD, PER_UAV


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
    left = decay(lag_s, step_s)
    mean = lag_s / step_s * (1.0 - left)
    # Four times the first moment about the middle of the step, over step^2.
    moment = 4.0 * ((lag_s / step_s) ** 2 * (1.0 - left) - lag_s / step_s * (1.0 + left) / 2.0)
    return mean - moment, mean + moment


def held(a: Array, u: Array, lag_s: float, step_s: float) -> tuple[tuple[Array, Array], Array]:
    """Return two inputs, held for half a step each, that stand for the actual ones a, (m,), and a at the end.

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
    left = np.zeros((3, 2, 4))
    left[:, 0] = np.array([*_deviations(lag_s, step_s), decay(lag_s, step_s)])[:, None]
    for axis, gain in enumerate(gains or (), start=1):
        left[:, :, axis] = _rate_shares(lag_s, step_s, gain)
    return np.tile(left, uavs)


def _rate_shares(lag_s: float, step_s: float, gain: float) -> Array:
    """Return the shares of one commanded body rate, (3, 2): z' = M z of [a, rate] under a zero command."""
    from scipy.linalg import expm  # 0.3 s at start; only a lag inside an inner loop needs it

    M = np.array([[gain - 1.0 / lag_s, -gain], [gain, -gain]])
    end = expm(M * step_s)
    area = np.linalg.solve(M, end - np.eye(2))
    mean = area[0] / step_s
    moment = 4.0 * (np.linalg.solve(M, step_s * end - area)[0] / step_s**2 - mean / 2.0)
    return np.array([mean - moment, mean + moment, end[0]])


def rate_places(m: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return the positions of body rates as inputs, in u of m inputs, and of the rates themselves, in x."""
    uavs, axes = np.divmod(np.arange(3 * m // INPUTS), 3)
    in_inputs = INPUTS * uavs + 1 + axes
    in_states = PAYLOAD + PER_UAV * uavs + OMEGA.start + axes
    return in_inputs, in_states


def integrate(
    model: Model,
    z: Array,
    u: Array,
    duration_s: float,
    steps: int,
    lag_s: float,
    forces: Array | None = None,
) -> tuple[Array, float]:
    """Return x or, with lag, [x, a] after constant commands, and the largest local error.

    Of order 4. Source: docs/equations.md (54), (58a).
    """
    if lag_s == 0.0:
        return model.integrate(z, u, duration_s, steps, forces=forces)
    x = z[: model.system.n]
    a = z[model.system.n :]
    step_s = duration_s / steps
    worst = 0.0
    for _ in range(steps):
        (first, second), a = _held_inputs(model, x, a, u, lag_s, step_s)
        for half in (first, second):
            x, error = model.integrate(x, half, step_s / 2.0, 1, forces=forces)
            worst = max(worst, error)
    return np.concatenate([x, a]), worst


def _held_inputs(
    model: Model, x: Array, a: Array, u: Array, lag_s: float, step_s: float
) -> tuple[tuple[Array, Array], Array]:
    """Return two held inputs that stand for the actual ones, and these at the end of a step."""
    gains = model.system.rate_gains
    if gains is None:
        return held(a, u, lag_s, step_s)
    in_inputs, in_states = rate_places(len(u))
    rates = np.zeros_like(u)
    rates[in_inputs] = x[in_states]

    left = shares(lag_s, step_s, tuple(gains.tolist()), model.system.N)
    first, second, end = u + left[:, 0] * (a - u) + left[:, 1] * (rates - u)
    return (first, second), end


@lru_cache(64)
def _with_lag(pattern: Pattern, rates: bool) -> tuple[Pattern, npt.NDArray[np.intp]]:
    """Return the pattern of a system [x, a] with motors, and the order of its entries, -1/lag and 1/lag, (m,) each.

        X = [[X, U], [0, -1/lag]],    U = [[0], [1/lag]],    P = [[P], [0]],    V_x = [V_x, V_u],    V_u = 0

    With commanded body rates the row of a' also is that of the body rate, with -1/lag on itself.
    """
    X, U, P, V_x, V_u, C = map(pattern.numbered, NAMES)
    n, m = U.shape
    follow, command = (
        np.diag(len(pattern.index) + 1.0 + np.arange(part * m, (part + 1) * m)) for part in (0, 1)
    )
    moved = np.zeros((m, n))
    if rates:
        inputs, states = rate_places(m)
        moved[inputs] = X[states]
    below = np.zeros((m, P.shape[1]))
    factors = [
        np.block([[X, U], [moved, follow]]), np.vstack([np.zeros((n, m)), command]), np.vstack([P, below]),
        np.hstack([V_x, V_u]), 0.0 * V_u, padded(C, n + m),
    ]  # fmt: skip
    order = np.concatenate([factor[factor > 0.0] for factor in factors]).astype(np.intp) - 1
    return Pattern.of(factors), order


def lagged(
    linear: Linearisation, a: Array, u: Array, lag_s: float, rates: bool = False
) -> Linearisation:
    """Return the expansion of [x, a] and the command u, from that of x and a.

    a' = (u - a) / lag, with commanded body rates + omega'. Source: docs/equations.md (55), (58a).
    """
    pattern, order = _with_lag(linear.pattern, rates)
    rate = np.full(len(a), 1.0 / lag_s)
    on_itself = -rate
    moving = (u - a) / lag_s
    if rates:
        inputs, states = rate_places(len(a))
        on_itself[inputs] += linear.pattern.dense(linear.values, "U")[states, inputs]
        moving[inputs] += linear.f[states]
    values = np.concatenate([linear.values, on_itself, rate])[order]
    return replace(linear, f=np.concatenate([linear.f, moving]), pattern=pattern, values=values)
