"""What an agent notes of its estimate for the log: the pose of the payload with its covariance, and how often."""

import numpy as np

from transport.agent.estimation.filter.belief import Belief
from transport.model import state
from transport.model.arrays import Array

# Time between two notes, s: the covariance of each tick is work.
NOTES_EVERY_S = 1.0

POSE = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")
_PLACES = np.r_[state.R0, state.THETA0]
_UPPER = np.triu_indices(len(POSE))  # the upper triangle of a covariance, row by row

# Names of the numbers of a note. The last two are the squared innovation of the last measurements
# in units of its covariance, and their number.
NAMES = (
    *POSE,
    *(f"covariance_{POSE[i]}_{POSE[j]}" for i, j in zip(*_UPPER, strict=True)),
    "surprise",
    "measurements",
)


def is_due(tick: int, period_s: float) -> bool:
    """Return whether an agent notes its estimate at a tick."""
    return tick > 0 and tick % max(1, round(NOTES_EVERY_S / period_s)) == 0


def pose_numbers(belief: Belief) -> Array:
    """Return the numbers named by `NAMES`."""
    covariance = belief.covariance
    P = covariance.P[np.ix_(_PLACES, _PLACES)]
    innovation = [covariance.squared_error, covariance.measurements]
    return np.concatenate([belief.x[_PLACES], P[_UPPER], innovation])


def poses(numbers: Array) -> tuple[Array, Array]:
    """Return estimated poses, (k, 6), and covariances, (k, 6, 6), from rows of such numbers."""
    upper = numbers[:, len(POSE) : -2]
    P = np.empty((len(numbers), len(POSE), len(POSE)))
    P[:, _UPPER[0], _UPPER[1]] = upper
    P[:, _UPPER[1], _UPPER[0]] = upper
    return numbers[:, : len(POSE)], P
