"""Tilt: the largest roll and pitch that a controller plans for its UAVs."""

import math

import numpy as np

from model import state
from model.arrays import Array
from mpc import condensing
from mpc.decision import Decision
from mpc.rows.interface import Block, StepData


class TiltRows:
    """Upper limits of all angles and steps, then lower limits, softened by one slack."""

    def __init__(self, decision: Decision) -> None:
        tilt = decision.settings.tilt
        starts = [state.uav_slice(uav).start + state.THETA.start for uav in decision.uavs if tilt is not None]
        self._angles = np.array([start + axis for start in starts for axis in (0, 1)], dtype=np.intp)
        self._limit = 0.0 if tilt is None else math.radians(tilt.limit_deg)
        self.penalties = np.array([] if tilt is None else [tilt.penalty])
        self._scale, self._decisions = decision.scale, decision.size
        self._half = decision.settings.horizon * len(self._angles)

    def template(self) -> Array:
        """Return the slack's column."""
        rows = np.zeros((2 * self._half, self._decisions + len(self.penalties)))
        rows[: self._half, self._decisions :] = -1.0
        rows[self._half :, self._decisions :] = 1.0
        return rows

    def fill(self, step: StepData, to: Block) -> None:
        """Write the angles' dependence on the decision, and their distance to the limit."""
        angles = (step.linear.x0[self._angles] + step.prediction.dX_free[1:, self._angles]).reshape(-1)
        upper, lower = to.A[: self._half], to.A[self._half :]
        condensing.fill(step.prediction.effect[self._angles] * self._scale, upper)
        lower[:, : self._decisions] = upper[:, : self._decisions]
        np.subtract(self._limit, angles, out=to.upper[: self._half])
        np.subtract(-self._limit, angles, out=to.lower[self._half :])
