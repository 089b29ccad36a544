"""A loss of time along the path: the payload slows, may rest, and goes on later by that time."""

from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array
from transport.model.curves import Curve

STOP_S = 1.0  # least time of slowing to a rest in silence, and of speeding up again, s


@dataclass(frozen=True, kw_only=True)
class Slowing:
    """The path falls behind by a time, along itself; with its old speed before and after.

    With a loss of at least a ramp it comes to a rest within that ramp.
    """

    since_s: float  # time from which on it slows, s
    lost_s: float  # by how much it is behind in the end, s
    ramp_s: float  # of slowing down, and of speeding up again, s

    def warped(self, t_s: Array, orders: int) -> Array:
        """Return the jets of the time w(t) along the path before, (orders, k), s: (77).

        At times of the maneuver, (k,), s.
        """
        # w = t - x s(t), with the share s of a straight curve (65) whose largest rate is 1 / x or less.
        duration_s = max(self.lost_s, self.ramp_s) + self.ramp_s
        lost = Curve(kind=None, duration_s=duration_s, ramp_s=self.ramp_s, size_I=(1.0, 0.0, 0.0))
        w = -self.lost_s * lost.covered(t_s - self.since_s, orders)
        w[0] += t_s
        if orders > 1:
            w[1] += 1.0
        return np.asarray(w)
