"""Decision to send a plan to the other agents: always, or when they would otherwise assume a wrong one for long.

With closed-loop prediction the others know the shared control law, but not the agent's corrections to it. They assume
the last shared corrections, shifted to the present tick and zero after their end.
"""

import math

import numpy as np

from model.arrays import Array
from protocol.scenario.schema import ControllerSection


class Sharing:
    """Event-triggered sharing of plans; smallest and largest inputs of the agent's UAVs, (4 owned,), are its scale."""

    def __init__(self, settings: ControllerSection, lower: Array, upper: Array) -> None:
        self._always = settings.share == "always"
        self._threshold = settings.share_threshold
        # At least one tick; rounding must not take one from a whole number of periods.
        self._heartbeat = max(1, math.floor(settings.share_heartbeat_s / settings.sampling_period_s + 1e-9))
        self._span = upper - lower
        self._tick = -1  # of the last shared plan, -1 before the first
        self._start, self._roster = 0, 0
        self._c = np.zeros((0, len(self._span)))

    def decide(self, tick: int, start: int, c: Array, roster: int) -> bool:
        """Decide whether to share a plan; the others assume a shared plan from then on.

        Shared are the first plan, the first one under each roster (control law or receivers may be new), one that is a
        heartbeat newer than the last shared one, and one whose corrections c to the shared control law, (N_p, 4 owned),
        from tick `start` on, have changed by more than the threshold. Source: docs/equations.md (49).
        """
        shared = (
            self._always
            or self._tick < 0
            or roster != self._roster
            or tick - self._tick >= self._heartbeat
            or self.change(start, c) > self._threshold
        )
        if shared:
            self._tick, self._start, self._c, self._roster = tick, start, c, roster
        return shared

    def change(self, start: int, c: Array) -> float:
        """Return the largest difference of corrections from those the others assume, as a share of the input's range.

        The corrections c, (N_p, 4 owned), begin at tick `start`.
        """
        assumed = np.zeros_like(c)
        left = self._c[start - self._start :][: len(c)]
        assumed[: len(left)] = left
        return float(np.max(np.abs(c - assumed) / self._span, initial=0.0))
