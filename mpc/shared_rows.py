"""Constraints of the user that several agents keep together: how much each corrects, and what a violation costs."""

import numpy as np
import numpy.typing as npt

from transport.model import state
from transport.model.arrays import Array
from transport.mpc.settings import Weights

# Tracking error whose cost a violation by one unit may cause, m: as far as UAVs are from each other.
_ERROR_M = 1.0


def share(depends: npt.NDArray[np.bool_], own: npt.NDArray[np.intp]) -> Array:
    """Return the factors by which an agent takes the effect of its inputs on rows of inputs, (rows,).

    Every agent in a row sees the whole violation. With its own effect multiplied by the number of UAVs in the row over
    the owned ones it corrects its share, and all of them together the violation. Rows of owned inputs alone have 1.

    Args:
        depends: Which inputs are in each row, (rows, m).
        own: Positions of the owned inputs, (m_own,).
    Source: docs/equations.md (30c).
    """
    uavs = depends.shape[1] // state.INPUTS
    by_uav = np.asarray(depends.reshape(len(depends), uavs, state.INPUTS).any(axis=2))
    owned = np.unique(own // state.INPUTS)
    return np.asarray(by_uav.sum(axis=1) / np.maximum(by_uav[:, owned].sum(axis=1), 1))


def default_penalty(weights: Weights, uavs: int) -> float:
    """Return the penalty on a violation by one unit, in the scale of the cost: docs/equations.md (30d).

    It is the slope of the team's tracking cost at an error of a metre. A steeper one makes a wall of the constraint, at
    which agents with late plans correct each other.
    """
    return 2.0 * _ERROR_M * (uavs * weights.position + weights.payload_position)
