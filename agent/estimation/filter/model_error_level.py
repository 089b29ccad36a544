"""Level of the model's errors: a share of their largest variance that follows the innovations.

In a steady state half of the covariance stands for the model's errors, whatever their size: a
variance that is not there makes the filter doubt itself. Innovations are white if the level is
right; their slow part is larger if it is too low, smaller if it is too high.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from transport.model.arrays import Array

# Time over which the slow part of the innovations is taken, s.
SLOW_S = 1.0
# Most excess of the slow part that counts in one tick.
MOST_EXCESS = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelRule:
    """Change of the level with the innovations; docs/equations.md (63b)."""

    first: float  # level at the start
    least: float
    white: float  # mu: squared slow part at which the level stays; 1 is that of white innovations
    by_prediction: bool  # whether an entry counts as much as the prediction errs in it
    rate: float  # gamma: change of the level's logarithm in a tick per excess of the slow part


# A model without unknown forces is exact until innovations deny it.
EXACT = LevelRule(first=1e-4, least=1e-6, white=1.15, by_prediction=False, rate=0.2)
# Wind must be noticed quickly while it blows.
WIND = LevelRule(first=1.0, least=1e-4, white=0.5, by_prediction=True, rate=0.1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """The level at a tick, and the innovations that it follows."""

    value: float  # lambda, at most 1
    slow: Array  # sigma: slow part of the innovations in units of their deviations, (15 N,)


def followed(
    level: Level,
    rule: LevelRule,
    period_s: float,
    entries: npt.NDArray[np.intp],
    innovations: tuple[Array, Array, Array],
) -> Level:
    """Return the level after the innovations of some entries of all measurements.

    Given are the innovations z - h, their variances diag(S), and those of the sensors R, (k,) each.
    Source: docs/equations.md (63b).
    """
    error, S, R = innovations
    kept = math.exp(-period_s / SLOW_S)

    #   sigma^+ = a sigma + (1 - a^2)^(1/2) diag(S)^(-1/2) (z - h)
    slow = level.slow.copy()
    slow[entries] = kept * slow[entries] + error * np.sqrt((1.0 - kept**2) / S)

    #   lambda^+ = lambda exp(gamma (sum w sigma^2 / sum w - mu))
    weights = 1.0 - R / S if rule.by_prediction else np.ones(len(R))
    excess = float(weights @ (slow[entries] ** 2 - rule.white) / weights.sum())
    limited = min(max(excess, -1.0), MOST_EXCESS)
    value = level.value * math.exp(rule.rate * limited)
    return Level(value=min(max(value, rule.least), 1.0), slow=slow)
