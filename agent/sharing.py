"""When an agent sends its plan to the other agents: always, or when they would believe something wrong for long.

With closed-loop prediction the others know the shared law. What they cannot know are the agent's corrections to it, so
these decide: the last shared ones, shifted to now and zero after their end, are what the others believe.
"""

import math

import numpy as np

from model.arrays import Array
from protocol.scenario.schema import ControllerSection


class Sharing:
    """Decides, plan by plan, whether the other agents get it.

    Args:
        settings: Whether to share always; otherwise the threshold and the heartbeat.
        lower: Smallest inputs of the agent's UAVs, (4 owned,).
        upper: Largest inputs, (4 owned,).
    """

    def __init__(self, settings: ControllerSection, lower: Array, upper: Array) -> None:
        self._always = settings.share == "always"
        self._threshold = settings.share_threshold
        # At least one tick; a heartbeat that is a whole number of periods must not lose one by rounding.
        self._heartbeat = max(1, math.floor(settings.share_heartbeat_s / settings.sampling_period_s + 1e-9))
        self._span = upper - lower
        self._tick = -1  # of the last shared plan, -1 before the first
        self._start, self._roster = 0, 0
        self._c = np.zeros((0, len(self._span)))

    def decide(self, tick: int, start: int, c: Array, roster: int) -> bool:
        """Whether to share the plan of a tick; what is shared is from then on what the others believe.

        Shared are the first plan, the first one under each roster (the law may be another, or a receiver may be
        new), one that is a heartbeat younger than the last, and one whose corrections have changed by more than
        the threshold.

        Args:
            tick: Of the plan.
            start: First instant the corrections are for.
            c: Corrections to the shared law, (N_p, 4 owned).
            roster: Version in force at the tick.
        Source: docs/equations.md (49).
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
        """Largest difference of corrections from what the others believe, as a share of the input's range.

        Args:
            start: First instant the corrections are for.
            c: Corrections, (N_p, 4 owned).
        """
        believed = np.zeros_like(c)
        left = self._c[start - self._start :][: len(c)]
        believed[: len(left)] = left
        return float(np.max(np.abs(c - believed) / self._span, initial=0.0))
