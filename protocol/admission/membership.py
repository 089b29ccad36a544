"""Membership of a run as one process knows it: the newest roster, and which plans count."""

from collections import deque
from typing import Any

from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import Plan, Roster
from transport.protocol.wire.names import COORDINATOR

_KEPT = 1024  # plans kept for a roster to come: a few ticks of a large team
_EMPTY: dict[str, Any] = {"agents": (), "incarnations": (), "off": (), "released": (), "reason": ""}
_NONE = Roster(sender=COORDINATOR, incarnation=0, sequence=0, tick=0, version=0, **_EMPTY)


class Membership:
    """The newest roster and the plans ahead of it, also of an agent, `own`, that is off it.

    A plan is refused by `check` if no roster, now or to come, can admit it. One that counts is taken
    at once. Any other waits for the next roster, which `update` takes in.

    Attributes:
        version: Version of the newest roster.
        failed_since: Tick of the newest failure of a UAV.
        since: Tick from which each agent is on the roster in its present incarnation.
        incarnations: Incarnations of the agents on it.
    """

    def __init__(self, own: int | None = None) -> None:
        self.version = 0
        self.failed_since = 0
        self.since: dict[int, int] = {}
        self.incarnations: dict[int, int] = {}

        self._own = own
        self._newest: dict[int, int] = {}  # highest incarnation ever on a roster
        self._early: deque[Plan] = deque(maxlen=_KEPT)
        # By departed agent: its last incarnation, and the tick at which it departed.
        self._departed: dict[int, tuple[int, int]] = {}
        self._rosters = [_NONE]  # ascending, from the one in force on

    def took_part(self, tick: int) -> set[int]:
        """Return the agents whose plans of a tick are here or still to come.

        Also of those that have departed since.
        """
        present = {agent for agent, since in self.since.items() if since <= tick}
        were_present = {agent for agent, (_, departed) in self._departed.items() if tick < departed}
        return present | were_present

    def at(self, version: int) -> Roster:
        """Return the roster in force where a tick names its version; forget older ones.

        It is the same at all processes.
        """
        while len(self._rosters) > 1 and self._rosters[1].version <= version:
            del self._rosters[0]
        return self._rosters[0]

    def update(self, roster: Roster) -> list[Plan]:
        """Take in a roster newer than all before; return the plans that were ahead of it."""
        newest = self._rosters[-1]
        if (roster.off, roster.released) != (newest.off, newest.released):
            self.failed_since = roster.tick
        self.version = roster.version
        self._rosters.append(roster)

        before = self.incarnations
        self.incarnations = dict(zip(roster.agents, roster.incarnations, strict=True))
        staying = dict(before.items() & self.incarnations.items())
        for agent in before.keys() - staying.keys():
            self._departed[agent] = (before[agent], roster.tick)
        self.since = {
            agent: self.since[agent] if agent in staying else roster.tick
            for agent in self.incarnations
        }
        for agent, incarnation in self.incarnations.items():
            self._newest[agent] = max(incarnation, self._newest.get(agent, incarnation))

        waiting = list(self._early)
        self._early.clear()
        return waiting

    def check(self, plan: Plan) -> None:
        """Raise MessageError for a plan that neither this roster nor one to come admits."""
        is_old = plan.incarnation <= self._newest.get(plan.agent, -1)
        if is_old and not self._counts(plan):
            text = "plan of an incarnation that is not on the roster"
            raise MessageError("wrong_incarnation", text)

    def admit_or_keep(self, plan: Plan) -> bool:
        """Return whether a plan counts now; keep one that does not for a roster to come."""
        if self._counts(plan) and (self._own is None or self._own in self.since):
            return True
        self._early.append(plan)
        return False

    def _counts(self, plan: Plan) -> bool:
        """Return whether the sender is on the roster, or was when it sent the plan.

        Such a plan counts at all receivers.
        """
        if self.incarnations.get(plan.agent) == plan.incarnation:
            return True
        incarnation, departed = self._departed.get(plan.agent, (-1, 0))
        return plan.incarnation == incarnation and plan.tick < departed
