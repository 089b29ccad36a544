"""Constraints of the user that several agents keep together: how much each corrects, and what a violation costs."""

import numpy as np
import numpy.typing as npt

from transport.model import state
from transport.model.arrays import Array
from transport.mpc.settings_period_horizon_weights import Weights

# Tracking error whose cost a violation by one unit may cause at one step, m: as far as UAVs are from
# each other.
_ERROR_M = 1.0
# Error by which a place is kept from its reference at every step of the horizon, m.
_KEPT_AWAY_M = 0.4


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


def default_penalties(weights: Weights, uavs: int, horizon: int) -> tuple[float, float]:
    """Return the penalties on a violation by one unit, of places and of all else: (30d).

    They are slopes of the team's tracking cost. A row on the place of a body keeps the team from its
    reference by as much at every step, so its slope is that of the whole horizon. For all else it is
    that of one step at an error of a metre: a steeper one makes a wall of the constraint, at which
    agents with late plans correct each other.
    """
    slope = 2.0 * (uavs * weights.position + weights.payload_position)  # 1/m of error, of one step
    return horizon * _KEPT_AWAY_M * slope, _ERROR_M * slope
