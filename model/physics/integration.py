"""Integration by equal steps, or by steps that are halved until their error is small.

Source: docs/equations.md (13b), (13c).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array

# From a state, (n,), and the length of a step, s, to the state after it and the estimate of its
# local error, (n,) each, SI.
Step = Callable[[Array, float], tuple[Array, Array]]


@dataclass(frozen=True, slots=True, kw_only=True)
class StepLimits:
    """Limits of an integration's steps: docs/equations.md (13c)."""

    tolerance: float = math.inf  # largest local error of a step, SI; infinite: equal steps
    shortest: float = 2.0**-12  # length relative to the equal steps: 2.4 us of 10 ms
    most_tried: int = 20_000  # in one integration: about a second


def integrate(
    step: Step, x: Array, duration_s: float, steps: int, limits: StepLimits
) -> tuple[Array, float]:
    """Return the state after a duration, (n,), and the largest local error of its steps, SI.

    Equal steps, >= 1, each replaced by two of half its length where its error exceeds the
    tolerance. At the limits a step is accepted as it is.
    """
    equal_s = duration_s / steps
    is_limited = limits.tolerance < math.inf

    ahead_s = [equal_s] * steps  # still to take, the next one last
    tried = 0
    largest = 0.0
    while ahead_s:
        h = ahead_s.pop()
        x_next, errors = step(x, h)
        error = float(np.abs(errors).max())
        tried += 1

        is_accurate = error <= limits.tolerance  # false for nan
        may_halve = tried < limits.most_tried and h > limits.shortest * equal_s
        if is_limited and not is_accurate and may_halve:
            ahead_s += [h / 2.0, h / 2.0]
            continue

        x = x_next
        largest = error if math.isnan(error) else max(largest, error)
        if is_limited and not np.isfinite(x).all():
            break
    return x, largest
