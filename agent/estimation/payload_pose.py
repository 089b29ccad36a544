"""Pose of the payload as an agent reports it to the log: estimate, covariance, and innovations."""

import numpy as np

from transport.agent.estimation.belief import Belief
from transport.model import state
from transport.model.arrays import Array

POSE = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")
_PLACES = np.r_[state.R0, state.THETA0]
_UPPER = np.triu_indices(len(POSE))  # the upper triangle of a covariance, row by row

# Names of the numbers of a report. The last two are the squared innovation of the last measurements
# in units of its covariance, and their number.
NAMES = (
    *POSE,
    *(f"covariance_{POSE[i]}_{POSE[j]}" for i, j in zip(*_UPPER, strict=True)),
    "surprise",
    "measurements",
)


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
