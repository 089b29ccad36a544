"""Who takes part, as a node knows it from the rosters it has received.

Plans and rosters come over different connections, so a plan may overtake the roster that admits its sender.
Such a plan is kept until the roster is here; a plan of an earlier incarnation is refused.
"""

from protocol.wire.messages import MessageError, Plan, Roster

# Plans kept for a roster to come: a few ticks of a large team. Beyond that somebody is talking out of turn.
_KEPT = 1024


class Membership:
    """The newest roster and the plans that are ahead of it.

    Attributes:
        version: Of the newest roster, 0 before the first.
        agents: Agents on it.
        since: From which tick on each of them is on the roster in its present incarnation.
        failed_since: Tick of the newest failure of a UAV, 0 before the first.
    """

    def __init__(self) -> None:
        self.version = self.failed_since = 0
        self.since: dict[int, int] = {}
        self._incarnations: dict[int, int] = {}
        self._newest: dict[int, int] = {}  # highest incarnation ever on a roster
        self._early: list[Plan] = []
        self._left: dict[int, tuple[int, int]] = {}  # last incarnation of those that left, and the tick they did at
        self._closed: dict[int, int] = {}  # newest incarnation of each agent that is known to be gone
        self._history: dict[int, Roster | None] = {0: None}  # by version

    @property
    def agents(self) -> set[int]:
        """Agents on the newest roster."""
        return set(self._incarnations)

    def took_part(self, tick: int) -> set[int]:
        """Agents whose plans of a tick are here or still to come, also of those that have left since.

        Of those that have left, what they said before is on its way until their connection is closed.
        """
        present = {agent for agent, since in self.since.items() if since <= tick}
        left = {
            agent
            for agent, (incarnation, at) in self._left.items()
            if tick < at and incarnation > self._closed.get(agent, -1)
        }
        return present | left

    def close(self, name: str, incarnation: int) -> None:
        """A process is gone: whatever it has said has arrived, or never will."""
        agent = name.removeprefix("agent")
        if agent != name and agent.isdecimal():
            self._closed[int(agent)] = max(incarnation, self._closed.get(int(agent), -1))

    def agents_at(self, version: int) -> frozenset[int]:
        """Agents on the roster of a version: what everybody knows at a tick that names it, whatever has come since."""
        roster = self._roster_at(version)
        return frozenset() if roster is None else frozenset(roster.agents)

    def failed_at(self, version: int) -> tuple[frozenset[int], frozenset[int]]:
        """UAVs, 0-based, whose motors are off by the roster of a version, and those of them that are released."""
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
        """The incarnation in which an agent is on the roster, or None."""
        return self._incarnations.get(agent)

    def update(self, roster: Roster) -> list[Plan]:
        """Take in a roster.

        Returns: Plans that were ahead of it, to be received again.
        Raises: MessageError: it is not newer than the one in force.
        """
        if roster.version <= self.version:
            raise MessageError("past", f"roster of version {roster.version} after version {self.version}")
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
        waiting, self._early = self._early, []
        return waiting

    def admits(self, plan: Plan) -> bool:
        """Whether a plan's sender is on the roster; otherwise the plan is kept for a roster to come.

        Raises: MessageError: no roster to come will admit it, or too many wait for one.
        """
        if self._incarnations.get(plan.agent) == plan.incarnation:
            return True
        incarnation, at = self._left.get(plan.agent, (-1, 0))
        if plan.incarnation == incarnation and plan.tick < at:
            return True  # said while it took part: on every connection it counts
        if plan.incarnation <= self._newest.get(plan.agent, -1):
            raise MessageError("wrong_incarnation", "plan of an incarnation that is not on the roster")
        if len(self._early) >= _KEPT:
            raise MessageError("wrong_incarnation", "plan of an incarnation that no roster has admitted")
        self._early.append(plan)
        return False
