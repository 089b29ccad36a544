"""Targets that wait until all agents on the roster are known to have them (`controller.targets`).

An agent notes at which tick each agent got a target, as far as plans tell: they carry these ticks, so that
they go round a cut link as the target does. An agent that knows that all on the roster have it follows
it from that tick on and says so in its plans; of two such ticks the earlier one counts: docs/equations.md (76).
"""

from collections.abc import Collection, Mapping

from msgspec.structs import replace

from transport.protocol.admission.targets_in_plans import Place, place_of
from transport.protocol.wire.messages import Target


class Unconfirmed:
    """Targets that one agent, 1-based, has and does not follow yet."""

    def __init__(self, agent: int) -> None:
        self._agent = agent
        self._targets: dict[Place, Target] = {}
        # By target and agent, the tick at which the agent got it: the newest known one.
        self._got: dict[Place, dict[int, int]] = {}

    def has(self, place: Place) -> bool:
        """Return whether a target is here."""
        return place in self._targets

    def take(self, target: Target, tick: int) -> bool:
        """Take in a target that is told or heard at a tick; return whether it is new."""
        place = place_of(target)
        self._targets.setdefault(place, target)
        got = self._got.setdefault(place, {})
        before = dict(got)
        got.setdefault(self._agent, tick)
        for agent, got_tick in zip(target.informed, target.got, strict=True):
            if agent != self._agent:
                got[agent] = max(got_tick, got.get(agent, 0))
        return got != before

    def returned(self, tick: int) -> None:
        """Tell from a tick on that this agent, which was off the roster, still has its targets."""
        for got in self._got.values():
            got[self._agent] = max(got[self._agent], tick)

    def confirmed(
        self, tick: int, members: Collection[int], since: Mapping[int, int]
    ) -> list[Target]:
        """Return the targets that all members have by a tick, their first one, oldest first; forget these.

        A member that got a target before it was on the roster, `since`, was another process then.
        """
        found = []
        for place in sorted(self._targets):
            got = self._got[place]
            if all(got.get(member, -1) >= since.get(member, 0) for member in members):
                found.append(replace(self._targets[place], begins=max(tick, 1)))  # 0 is none
        for target in found:
            self.forget(place_of(target))
        return found

    def forget(self, place: Place) -> None:
        """Forget a target, if it is here."""
        self._targets.pop(place, None)
        self._got.pop(place, None)

    def forget_before(self, place: Place) -> None:
        """Forget the targets that a newer one replaces."""
        for old in [old for old in self._targets if old < place]:
            self.forget(old)

    def carried(self) -> list[Target]:
        """Return the targets with what is known of the agents that have them, oldest first."""
        targets = []
        for place in sorted(self._targets):
            got = sorted(self._got[place].items())
            informed, ticks = zip(*got, strict=True)
            targets.append(replace(self._targets[place], informed=informed, got=ticks))
        return targets
