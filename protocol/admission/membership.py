"""The agents that take part, by the rosters a node has received; plans that overtake their roster are kept."""

from collections import deque
from typing import Any

from protocol.wire.errors import MessageError
from protocol.wire.messages import Plan, Roster
from protocol.wire.names import COORDINATOR

_KEPT = 1024  # plans kept for a roster to come: a few ticks of a large team
_EMPTY: dict[str, Any] = {"agents": (), "incarnations": (), "off": (), "released": (), "reason": ""}
_NONE = Roster(sender=COORDINATOR, incarnation=0, sequence=0, tick=0, version=0, **_EMPTY)


class Membership:
    """The newest roster and the plans that are ahead of it; of an agent, `own`, also while it is off the roster."""

    def __init__(self, own: int | None = None) -> None:
        self.version = 0  # of the newest roster
        self.failed_since = 0  # tick of the newest failure of a UAV
        self.since: dict[int, int] = {}  # tick from which each agent is on it in its present incarnation
        self.incarnations: dict[int, int] = {}  # of the agents on it
        self._own = own
        self._newest: dict[int, int] = {}  # highest incarnation ever on a roster
        self._early: deque[Plan] = deque(maxlen=_KEPT)
        self._left: dict[int, tuple[int, int]] = {}  # by agent that left: its last incarnation, the tick it left at
        self._rosters = [_NONE]  # ascending, from the one in force on

    def took_part(self, tick: int) -> set[int]:
        """Return the agents whose plans of a tick are here or, also of those that have left since, still to come."""
        present = {agent for agent, since in self.since.items() if since <= tick}
        return present | {agent for agent, (_, at) in self._left.items() if tick < at}

    def at(self, version: int) -> Roster:
        """Return the roster in force where a tick names its version, the same at all processes; forget older ones."""
        while len(self._rosters) > 1 and self._rosters[1].version <= version:
            del self._rosters[0]
        return self._rosters[0]

    def update(self, roster: Roster) -> list[Plan]:
        """Take in a roster, newer than the one in force; return the plans that were ahead of it."""
        newest = self._rosters[-1]
        if (roster.off, roster.released) != (newest.off, newest.released):
            self.failed_since = roster.tick
        self.version = roster.version
        self._rosters.append(roster)
        before, self.incarnations = self.incarnations, dict(zip(roster.agents, roster.incarnations, strict=True))
        stay = dict(before.items() & self.incarnations.items())
        self._left |= {agent: (before[agent], roster.tick) for agent in before.keys() - stay.keys()}
        self.since = {agent: self.since[agent] if agent in stay else roster.tick for agent in self.incarnations}
        for agent, incarnation in self.incarnations.items():
            self._newest[agent] = max(incarnation, self._newest.get(agent, incarnation))
        waiting, self._early = list(self._early), deque(maxlen=_KEPT)
        return waiting

    def check(self, plan: Plan) -> None:
        """Raise MessageError for a plan that neither this roster nor one to come admits."""
        if not self._counts(plan) and plan.incarnation <= self._newest.get(plan.agent, -1):
            raise MessageError("wrong_incarnation", "plan of an incarnation that is not on the roster")

    def admits(self, plan: Plan) -> bool:
        """Return whether a plan counts now; otherwise keep it for a roster to come."""
        if self._counts(plan) and (self._own is None or self._own in self.since):
            return True
        self._early.append(plan)
        return False

    def _counts(self, plan: Plan) -> bool:
        """Return whether the sender is on the roster, or was when it sent the plan: that counts at all receivers."""
        incarnation, at = self._left.get(plan.agent, (-1, 0))
        return self.incarnations.get(plan.agent) == plan.incarnation or (
            plan.incarnation == incarnation and plan.tick < at
        )
