"""Age of information: ticks since the last solved step of another agent, now, usually and in the mean.

Source: docs/equations.md (32c).
"""

from collections import deque
from collections.abc import Iterable
from typing import NamedTuple


class InformationAge(NamedTuple):
    """Age of the newest plan of another agent, ticks."""

    mean: float  # over the last second
    overdue: float  # of now, beyond the usual one, which is the smallest of some seconds


# Of an agent that is not waited for: the agent itself, and those off the roster.
NO_WAIT = InformationAge(mean=0.0, overdue=0.0)


class InformationAges:
    """Ages of the newest plans of the others, and how old they usually are, ticks.

    Args:
        peers: Numbers of the others, 1-based.
        window: Ticks over which the usual age is the smallest.
        recent: Ticks over which ages are averaged.
    """

    def __init__(self, peers: Iterable[int], window: int = 1, recent: int = 1) -> None:
        self._ages: dict[int, deque[int]] = {agent: deque(maxlen=window) for agent in peers}
        self._recent: dict[int, deque[int]] = {agent: deque(maxlen=recent) for agent in peers}
        # Smallest age in the window; sum and mean of the recent ones. The sum of integers is exact.
        self._usual: dict[int, int] = {}
        self._sums = dict.fromkeys(self._recent, 0)
        self._mean: dict[int, float] = {}

    def observe(self, agent: int, age: int) -> None:
        """Take in the age of the newest plan of an agent at the next tick."""
        ages = self._ages[agent]
        leaving = ages[0] if len(ages) == ages.maxlen else None
        ages.append(age)

        usual = self._usual.get(agent, age)
        if age <= usual:
            self._usual[agent] = age
        elif leaving == usual:
            self._usual[agent] = min(ages)

        recent = self._recent[agent]
        if len(recent) == recent.maxlen:
            self._sums[agent] -= recent[0]
        recent.append(age)
        self._sums[agent] += age
        self._mean[agent] = self._sums[agent] / len(recent)

    def forget(self, agent: int) -> None:
        """Discard the ages of an agent that starts anew."""
        self._ages[agent].clear()
        self._recent[agent].clear()
        self._sums[agent] = 0
        self._usual.pop(agent, None)
        self._mean.pop(agent, None)

    def usual(self, agent: int) -> int:
        """Return the smallest age of an agent's information in the window; 1 where there has been none."""
        return self._usual.get(agent, 1)

    def mean(self, agent: int) -> float:
        """Return the mean age of an agent's information over the last second; 1 where there is none."""
        return self._mean.get(agent, 1.0)
