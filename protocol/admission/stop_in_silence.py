"""Stop in silence (`controller.silence` stop): an agent without information slows its path to a rest.

Another may know what it does not. The states of an agent:

    going      along the path, `lag` ticks behind the given one
    stopping   it acts alone by more than half, or hears that another one does wholly: the path comes to a
               rest within `STOP_S`, at most at 1 m/s^2 in the mean

The path of UAVs whose agents are gone stops and goes on by the same rule, as one that acts alone as much as
the newest plan of any agent on the roster does.

Once neither holds, it goes on. Plans carry the lag; who hears of a larger one loses the difference, so that all
end at the largest, the least progress. Source: docs/equations.md (77).
"""

import math
from collections.abc import Iterable

from transport.model.path.target_and_stop import STOP_S, Slowing
from transport.protocol.wire.messages import Plan

# Mean deceleration of a stop, m/s^2: the largest is twice that.
_MEAN_MPS2 = 1.0
MOSTLY = 0.5  # share of acting alone from which on an agent stops


class Stopping:
    """Progress of one agent along its path.

    Args:
        period_s: Sampling period.
        ticks: Ticks of the run: a stop lasts until its end unless there is information.

    Attributes:
        lag: Ticks by which its path is, or will be, behind the given one, without a stop that lasts.
    """

    def __init__(self, period_s: float, ticks: int) -> None:
        self.lag = 0
        self._period_s = period_s
        self._ticks = ticks
        self._ramp_s = STOP_S  # of the stop under way
        self._ramp = round(2.0 * STOP_S / period_s)
        self._stopped: int | None = None  # tick from which on the path slows, while it does
        self._newest: dict[int, Plan] = {}
        self._is_new = True

    def begin_anew(self) -> None:
        """Take over the progress of the others at the first information, as after an absence."""
        self._is_new = True

    def hear(self, plans: Iterable[Plan]) -> None:
        """Take in plans of others."""
        for plan in plans:
            newest = self._newest.get(plan.agent)
            if newest is None or plan.tick > newest.tick:
                self._newest[plan.agent] = plan

    def is_any_alone(self, roster: Iterable[int]) -> bool:
        """Return whether an agent on the roster acts alone by more than half, as its newest plan says."""
        heard = [self._newest[agent] for agent in roster if agent in self._newest]
        return any(plan.alone > MOSTLY for plan in heard)

    def advance(
        self, k: int, *, is_alone: bool, roster: Iterable[int], speed_mps: float
    ) -> Slowing | None:
        """Return the loss of time that begins, or whose length is known, at tick k; None for none.

        The path has that speed now, and takes more time to stop from a larger one.
        """
        heard = [self._newest[agent] for agent in roster if agent in self._newest]
        largest = max((plan.lag for plan in heard), default=0)
        if self._is_new:
            if k > 0 and not heard and not is_alone:
                return None
            self._is_new = k > 0 and not heard
            lost = largest - self.lag
            if k > 0 and lost > 0 and self._stopped is None:
                # Its UAVs have not flown by this path: it is behind at once.
                before = -2 * self._ticks - self._ramp - self.lag
                self.lag = largest
                return self._loss(before, lost)

        waits = is_alone or any(plan.alone == 1.0 for plan in heard)
        if self._stopped is None and waits:
            self._stopped = k
            self._ramp_s = max(STOP_S, speed_mps / _MEAN_MPS2)
            return self._loss(k, self._ticks, self._ramp_s)
        if self._stopped is not None:
            if waits:
                return None
            since, self._stopped = self._stopped, None
            lost = max(k - since, math.ceil(self._ramp_s / self._period_s))
            self.lag += lost
            return self._loss(since, lost, self._ramp_s)
        if largest > self.lag:
            lost, self.lag = largest - self.lag, largest
            return self._loss(k, lost)
        return None

    def behind(self, k: int) -> int:
        """Return the ticks by which the path is behind at tick k, at most."""
        return self.lag + (0 if self._stopped is None else k - self._stopped)

    def _loss(self, tick: int, lost: int, ramp_s: float = STOP_S) -> Slowing:
        since_s, lost_s = tick * self._period_s, lost * self._period_s
        return Slowing(since_s=since_s, lost_s=lost_s, ramp_s=ramp_s)
