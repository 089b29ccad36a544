"""Steps of the agents without a solution, and the verdict on them at the end of a run."""

from collections import Counter, defaultdict

from transport.coordinator.roster import names
from transport.protocol.wire.messages import MAX_TEXT, Plan


class FailedSteps:
    """Steps and failed steps of each agent, counted by the status of its plans.

    The limit holds for each agent: in the mean over a large team an agent whose controller never
    works would not show.

    Attributes:
        allowed: Largest share of an agent's steps that may fail (`agents.failed_share`).
    """

    def __init__(self, allowed: float) -> None:
        self.allowed = allowed
        self._steps = Counter[int]()
        self._failed = Counter[int]()

    def count(self, plan: Plan) -> None:
        """Count one step of an agent by its last plan of a tick."""
        self._steps[plan.agent] += 1

        if plan.status != "solved":
            self._failed[plan.agent] += 1

    def verdict(self) -> str:
        """Return a sentence about all failed agents if one has failed too often, otherwise "".

        Agents with equal counts are named together. In a team too large for one message the
        sentence has the number of agents and the worst of them.
        """
        shares = {agent: self._failed[agent] / self._steps[agent] for agent in self._failed}
        worst = max(sorted(shares), key=lambda agent: shares[agent], default=None)
        if worst is None or shares[worst] <= self.allowed:
            return ""

        agents_by_count = defaultdict[tuple[int, int], list[int]](list)
        for agent in sorted(self._failed):
            agents_by_count[self._failed[agent], self._steps[agent]].append(agent)

        limit = f"at most {100.0 * self.allowed:.4g} % of an agent's steps may fail"
        by_count = [
            f"{names(agents)} failed in {_of(*counts)}{' each' if len(agents) > 1 else ''}"
            for counts, agents in agents_by_count.items()
        ]
        text = f"{'; '.join(by_count)}; {limit}"
        if len(text) <= MAX_TEXT:
            return text

        counts_of_worst = _of(self._failed[worst], self._steps[worst])
        return f"{len(shares)} agents failed, {names([worst])} in {counts_of_worst}; {limit}"


def _of(failed: int, steps: int) -> str:
    """Return a count of failed steps in words."""
    return f"{failed} of {steps} steps"
