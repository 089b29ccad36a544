"""Rate limits: the largest change of each owned input from step to step."""

import numpy as np

from model.arrays import Array
from mpc.decision import Decision
from mpc.rows.interface import Block, StepData


class RateRows:
    """Rate limits between the steps of the horizon; the change at the first step is a bound (`Decision.bounds`).

    Source: docs/equations.md (28a).
    """

    penalties = np.zeros(0)

    def __init__(self, decision: Decision) -> None:
        self._scale = np.tile(decision.scale, decision.settings.horizon)
        self._rates = np.tile(decision.rate, decision.settings.horizon - 1)
        self._shape = decision.shape

    def template(self) -> Array:
        """Return the differences of successive decisions."""
        rows: Array = rate_rows(*self._shape) * self._scale
        return rows

    def fill(self, step: StepData, to: Block) -> None:
        """Write the bounds."""
        U_free = step.prediction.U_free
        drift = (U_free[1:] - U_free[:-1]).reshape(-1)
        to.lower[:], to.upper[:] = -self._rates - drift, self._rates - drift


def rate_rows(steps: int, m: int) -> Array:
    """Return the differences of successive decisions, ((steps - 1) m, steps m)."""
    rows = np.zeros(((steps - 1) * m, steps * m))
    index = np.arange((steps - 1) * m)
    rows[index, index] = -1.0
    rows[index, index + m] = 1.0
    return rows
