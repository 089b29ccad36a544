"""First-order lag of the motors: the actual inputs a follow the commanded inputs u by a' = (u - a) / lag.

Under a held command a decays exponentially towards it, so over one step it is known in closed form. The motion under
it is integrated with two held inputs per step that have the step's mean and first moment: a commutator-free Magnus
method of order 4 (Blanes, Moan 2006), for which any integrator of held inputs will do.

A state with motors is z = [x, a], (n + m,).
"""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from model.arrays import Array
from model.factors import with_lag
from model.linearisation import Linearisation, Model


def decay(lag_s: float, duration_s: float) -> float:
    """Return the share of a deviation from a held command that is left after a duration, s; 0 without lag."""
    return math.exp(-duration_s / lag_s) if lag_s > 0.0 else 0.0


@lru_cache
def deviations(lag_s: float, step_s: float) -> tuple[float, float]:
    """Return the deviations of two held inputs, half a step each, that stand for exp(-t / lag) over a step.

    They have its mean and its first moment over the step, s. Source: docs/equations.md (54).
    """
    left = decay(lag_s, step_s)
    mean = lag_s / step_s * (1.0 - left)
    # Four times the first moment about the middle of the step, over step^2.
    moment = 4.0 * ((lag_s / step_s) ** 2 * (1.0 - left) - lag_s / step_s * (1.0 + left) / 2.0)
    return mean - moment, mean + moment


def held(a: Array, u: Array, lag_s: float, step_s: float) -> tuple[tuple[Array, Array], Array]:
    """Return two inputs, held for half a step each, that stand for the actual ones, and the actual ones at its end.

    Args:
        a: Actual inputs at the beginning of the step, (m,).
        u: Command, held, (m,).
        lag_s: Time constant > 0, s.
        step_s: s.
    Source: docs/equations.md (53), (54).
    """
    deviation = a - u
    first, second = deviations(lag_s, step_s)
    return (u + first * deviation, u + second * deviation), u + decay(lag_s, step_s) * deviation


def integrate(
    model: Model, z: Array, u: Array, duration_s: float, steps: int, lag_s: float, forces: Array | None = None
) -> tuple[Array, float]:
    """Return the state after `duration_s` of constant commands; global error of order 4 in the step.

    Args:
        model: Equations of motion.
        z: State x, (n,), without lag; with lag [x, a], (n + m,).
        u: Command, held, (m,).
        duration_s: s.
        steps: Number of equal steps, >= 1.
        lag_s: Time constant of the motors, s; without lag the actual inputs are the command.
        forces: External forces, held; see `Model.integrate`.
    Returns: State, of the size of z, and the largest local error estimate of the integration under held inputs, SI.
    Source: docs/equations.md (53), (54).
    """
    if lag_s == 0.0:
        return model.integrate(z, u, duration_s, steps, forces=forces)
    x, a, worst, step_s = z[: model.system.n], z[model.system.n :], 0.0, duration_s / steps
    for _ in range(steps):
        inputs, a = held(a, u, lag_s, step_s)
        for half in inputs:
            x, error = model.integrate(x, half, step_s / 2.0, 1, forces=forces)
            worst = max(worst, error)
    return np.concatenate([x, a]), worst


def lagged(linear: Linearisation, a: Array, u: Array, lag_s: float) -> Linearisation:
    """Return the expansion of motion and motors, in deviations of z = [x, a] and of the command.

    Args:
        linear: Expansion of the motion about a state and the actual inputs.
        a: The actual inputs, (m,).
        u: Command about which the commands are expanded, (m,).
        lag_s: Time constant > 0, s.
    Source: docs/equations.md (55).
    """
    pattern, order = with_lag(linear.pattern)
    rate = np.full(len(a), 1.0 / lag_s)
    values = np.concatenate([linear.values, -rate, rate])[order]
    return replace(linear, f=np.concatenate([linear.f, (u - a) / lag_s]), pattern=pattern, values=values)
