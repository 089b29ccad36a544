"""The agents that take part, as a node knows them from the rosters it has received.

Plans and rosters come over different connections, so a plan may overtake the roster that admits its sender.
Such a plan is kept until the roster is here; a plan of an earlier incarnation is refused.
"""

from collections import deque

from protocol.wire.message import MessageError
from protocol.wire.messages import Plan, Roster

# Plans kept for a roster to come: a few ticks of a large team.
_KEPT = 1024


class Membership:
    """The newest roster and the plans that are ahead of it.

    Attributes:
        version: Version of the newest roster, 0 before the first.
        since: Tick from which each agent is on the roster in its present incarnation.
        failed_since: Tick of the newest failure of a UAV, 0 before the first.
    """

    def __init__(self) -> None:
        self.version = self.failed_since = 0
        self.since: dict[int, int] = {}
        self._incarnations: dict[int, int] = {}
        self._newest: dict[int, int] = {}  # highest incarnation ever on a roster
        self._early: deque[Plan] = deque(maxlen=_KEPT)
        self._left: dict[int, tuple[int, int]] = {}  # by agent that left: its last incarnation, the tick it left at
        self._history: dict[int, Roster | None] = {0: None}  # by version

    @property
    def agents(self) -> set[int]:
        """Agents on the newest roster."""
        return set(self._incarnations)

    def took_part(self, tick: int) -> set[int]:
        """Return the agents whose plans of a tick are here or still to come.

        Plans of an agent that has left since may be on their way: the tick names the plans that come.
        """
        present = {agent for agent, since in self.since.items() if since <= tick}
        left = {agent for agent, (_, at) in self._left.items() if tick < at}
        return present | left

    def agents_at(self, version: int) -> frozenset[int]:
        """Return the agents on the roster of a version, the same at all processes at a tick that names the version."""
        roster = self._roster_at(version)
        return frozenset() if roster is None else frozenset(roster.agents)

    def failed_at(self, version: int) -> tuple[frozenset[int], frozenset[int]]:
        """Return the UAVs (0-based) whose motors are off by the roster of a version, and the released among them."""
        return self._failed(self._roster_at(version))

    @staticmethod
    def _failed(roster: Roster | None) -> tuple[frozenset[int], frozenset[int]]:
        if roster is None:
            return frozenset(), frozenset()
        return frozenset(uav - 1 for uav in roster.off), frozenset(uav - 1 for uav in roster.released)

    def _roster_at(self, version: int) -> Roster | None:
        known = max((v for v in self._history if v <= version), default=min(self._history))
        for old in [v for v in self._history if v < known]:
            del self._history[old]
        return self._history[known]

    def incarnation(self, agent: int) -> int | None:
        """Return the incarnation in which an agent is on the roster, or None."""
        return self._incarnations.get(agent)

    def update(self, roster: Roster) -> list[Plan]:
        """Take in a roster, newer than the one in force; return the plans that were ahead of it."""
        newest = self._history.get(max(self._history))
        if self._failed(roster) != self._failed(newest):
            self.failed_since = roster.tick
        self.version = roster.version
        self._history[roster.version] = roster
        before = self._incarnations
        self._incarnations = dict(zip(roster.agents, roster.incarnations, strict=True))
        for agent, incarnation in before.items():
            if self._incarnations.get(agent) != incarnation:
                self._left[agent] = incarnation, roster.tick
        self.since = {
            agent: self.since[agent] if before.get(agent) == incarnation else roster.tick
            for agent, incarnation in self._incarnations.items()
        }
        for agent, incarnation in self._incarnations.items():
            self._newest[agent] = max(incarnation, self._newest.get(agent, incarnation))
        waiting = list(self._early)
        self._early.clear()
        return waiting

    def check(self, plan: Plan) -> None:
        """Refuse a plan that neither this roster nor one to come admits.

        Raises: MessageError: it is of an incarnation that is not on the roster.
        """
        if not self._counts(plan) and plan.incarnation <= self._newest.get(plan.agent, -1):
            raise MessageError("wrong_incarnation", "plan of an incarnation that is not on the roster")

    def admits(self, plan: Plan) -> bool:
        """Return whether a plan counts now; otherwise keep it for a roster to come."""
        if self._counts(plan):
            return True
        self._early.append(plan)
        return False

    def _counts(self, plan: Plan) -> bool:
        """Return whether the sender is on the roster, or was when it sent the plan: that counts at all receivers."""
        if self._incarnations.get(plan.agent) == plan.incarnation:
            return True
        incarnation, at = self._left.get(plan.agent, (-1, 0))
        return plan.incarnation == incarnation and plan.tick < at
