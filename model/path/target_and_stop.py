"""Changes of the path in flight: a target with the way to it, and a stop that loses time."""

from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array
from transport.model.path import taylor_jets as jets
from transport.model.path.curves import Curve

_FOR_GOOD_S = 1e6  # longer than any run
LOAD_S = 2.0  # time in which the weight of a load that has landed is handed over to the ground, s
STOP_S = 1.0  # least time of slowing to a rest in silence, and of speeding up again, s


@dataclass(frozen=True, kw_only=True, eq=False)
class PathTarget:
    """A target given during the flight.

    The payload leaves its path for it, and may run through a curve from there.
    """

    since_s: float  # time from which on the path changes, s
    point_I: Array  # position of the target, (3,), inertial frame, m
    approach: Curve  # straight, of length 1, whose share is that of the target in the path
    way: Curve | None = None  # from the target on; None: the target is the end
    # Whether the payload comes to a rest along the path before, within the time of the approach, in place
    # of going on along it.
    brakes: bool = False
    way_since_s: float = 0.0  # time before which the way does not begin, s
    lands: bool = False  # whether the end is on the ground, which then carries the payload

    @property
    def reached_s(self) -> float:
        """Time at which the payload's reference is at the target, s."""
        return self.since_s + self.approach.duration_s

    @property
    def leaves_s(self) -> float:
        """Time at which the way begins, s."""
        return max(self.reached_s, self.way_since_s)

    @property
    def ends_s(self) -> float:
        """Time from which on the reference is at rest, s."""
        return self.reached_s if self.way is None else self.leaves_s + self.way.duration_s

    @property
    def rests_s(self) -> float:
        """Time from which on the controllers' reference is at rest, s: the ground has a load that landed."""
        return self.ends_s + (LOAD_S if self.lands else 0.0)

    def ground_load(self, t_s: Array) -> tuple[Array, Array]:
        """Return the change of the level of (59) by a landing, and its rate, 1/s.

        At times of the maneuver, (k,), s.
        """
        if not self.lands:
            return np.zeros(len(t_s)), np.zeros(len(t_s))
        handover = Curve(kind=None, duration_s=LOAD_S, ramp_s=LOAD_S / 2.0, size_I=(1.0, 0.0, 0.0))
        share, rate = handover.covered(t_s - self.ends_s, 2)
        return share, rate

    @property
    def end_I(self) -> Array:
        """Position of the reference from then on, (3,), m."""
        end = self.goal(np.array([self.ends_s]), orders=1)
        return np.asarray(end[0, 0])

    def goal(self, t_s: Array, orders: int) -> Array:
        """Return the jets of p(t), the target and the curve after it, (orders, k, 3), SI.

        At times of the maneuver, (k,), s.
        """
        p = np.zeros((orders, len(t_s), 3))
        if self.way is not None:
            p = self.way.path(t_s - self.leaves_s, orders)
        p[0] += self.point_I
        return p

    @property
    def braking(self) -> "Slowing":
        """The loss of time along the path before with which it comes to a rest within the approach."""
        ramp_s = self.approach.duration_s
        return Slowing(since_s=self.since_s, lost_s=_FOR_GOOD_S, ramp_s=ramp_s)

    @property
    def rest_s(self) -> float:
        """Time along the path before at which a target that brakes ends it, s."""
        return self.since_s + self.approach.duration_s / 2.0

    def joined(self, t_s: Array, r: Array, rest_I: Array | None = None) -> Array:
        """Return the jets of a path since then led to the target, as smooth, (orders, k, 3): (75), (78).

        r: the jets of the path before, (orders, k, 3), at times of the maneuver, (k,), s; of a target that
        brakes, along it with `braking`, and `rest_I` its end, (3,), m.
        """
        orders = len(r)
        p = self.goal(t_s, orders)
        s = self.approach.covered(t_s - self.since_s, orders)[..., None]

        # r' = r + s (p - r), and p itself once it is reached; along a braked path r + s (p - r_rest).
        off = p - r if rest_I is None else p[:1] - rest_I
        mean = r + (jets.product(s, off) if rest_I is None else s * off)
        is_reached = (t_s >= self.reached_s)[:, None]
        return np.asarray(np.where(is_reached, p, mean))


@dataclass(frozen=True, kw_only=True)
class Slowing:
    """A loss of time along the path: the payload slows, may rest, and goes on later by that time.

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
