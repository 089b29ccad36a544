"""How much an agent acts alone: news of the others get old, and with them the reason to follow the team's control law.

Each agent decides by the age of its own news, so that agents without any network decide alike, and no agent waits for
another. Its plan says how much, so that those who hear it predict it. Source: docs/equations.md (32c)-(32e).
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from transport.agent.estimation.noise import OthersErrors
from transport.model.arrays import Array

# Age of news beyond the usual one at which an agent begins to act alone, and at which it does so wholly, s. A filter
# without news errs by centimetres within a second; a measured payload leaves only the others' UAVs to be predicted.
FILTERED_S, MEASURED_S = (0.5, 1.0), (1.0, 2.0)
# Window of the usual age of news, as a multiple of the age at which an agent acts alone wholly.
_WINDOW = 3.0
# Time from the team's law to the law alone, and back, s: the return waits for the estimate to take in the news.
_TO_ALONE_S, _TO_TEAM_S = 0.5, 2.0
# Correlation of the errors of two agents, until news are older than usual.
SHARED = OthersErrors().correlation
_FORGETS_S = 0.3  # time constant in which own measurements replace what both know


@dataclass(frozen=True, slots=True, kw_only=True)
class Silence:
    """The rule by which an agent acts alone, in ticks of news beyond their usual age."""

    begins: float
    complete: float
    forgets: float  # of the correlation, after the age at which it begins

    @staticmethod
    def of(period_s: float, *, is_filtered: bool, heartbeat_s: float = 0.0) -> "Silence":
        """Return the rule for a sampling period; plans come at the latest after a heartbeat, s."""
        begins_s, complete_s = FILTERED_S if is_filtered else MEASURED_S
        return Silence(
            begins=(begins_s + heartbeat_s) / period_s,
            complete=(complete_s + heartbeat_s) / period_s,
            forgets=_FORGETS_S / period_s,
        )

    def alone(self, overdue: float) -> float:
        """Return the share of the law alone, 0 to 1, where news are overdue by so many ticks. Source: (32c)."""
        return min(max((overdue - self.begins) / (self.complete - self.begins), 0.0), 1.0)

    def correlation(self, overdue: float) -> float:
        """Return the correlation of two agents' errors where news are overdue by so many ticks. Source: (63c)."""
        if overdue <= self.begins:
            return SHARED
        return float(SHARED * np.exp((self.begins - overdue) / self.forgets))


class News:
    """Ages of the newest plans of the others, and how old they usually are."""

    def __init__(self, peers: Iterable[int], silence: Silence | None = None) -> None:
        ticks = 1 if silence is None else round(_WINDOW * silence.complete)
        self._ages: dict[int, deque[int]] = {agent: deque(maxlen=ticks) for agent in peers}

    def observe(self, agent: int, age: int) -> None:
        """Take in the age of the newest plan of an agent at the next tick, ticks."""
        self._ages[agent].append(age)

    def usual(self, agent: int) -> int:
        """Return the smallest recent age of an agent's news, ticks; 1 where there have been none."""
        return min(self._ages.get(agent, ()), default=1)


class Mixture:
    """Share of the law alone in an agent's inputs: it follows the rule at a limited rate. Source: (32d)."""

    def __init__(self, period_s: float) -> None:
        self._up, self._down = period_s / _TO_ALONE_S, period_s / _TO_TEAM_S
        self.share = 0.0

    def advance(self, wanted: float) -> float:
        """Return the share one tick later, where the rule wants another one."""
        self.share += min(max(wanted - self.share, -self._down), self._up)
        return self.share


def mixed(team: Array, alone: Array, share: float, before: Array, step: Array) -> Array:
    """Return inputs between those of the team and alone, (N_p, 4 owned), that change by a step per period at most."""
    inputs = (1.0 - share) * team + share * alone
    for k in range(len(inputs)):
        previous = before if k == 0 else inputs[k - 1]
        inputs[k] = np.clip(inputs[k], previous - step, previous + step)
    return inputs
