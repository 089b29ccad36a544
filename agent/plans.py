"""Newest plans of all agents as one agent has received them."""

from bisect import bisect_left
from collections.abc import Iterable
from operator import attrgetter

from transport.protocol.wire.messages import Plan

# Plans kept per agent: enough for the past inputs over any usable delay.
KEPT_PLANS = 256


class ReceivedPlans:
    """Plans by agent, 1-based, ascending in the tick they were made at."""

    def __init__(self, agents: Iterable[int]) -> None:
        self._plans: dict[int, list[Plan]] = {agent: [] for agent in agents}

    def add(self, plan: Plan) -> None:
        """Keep a plan, in any order of arrival; a second plan of the same tick is ignored."""
        plans = self._plans[plan.agent]
        if not plans or plans[-1].tick < plan.tick:
            plans.append(plan)  # as most arrive
        else:
            index = bisect_left(plans, plan.tick, key=attrgetter("tick"))
            if plans[index].tick != plan.tick:
                plans.insert(index, plan)
        if len(plans) > KEPT_PLANS:
            del plans[0]

    def forget(self, agent: int) -> None:
        """Discard the plans of an agent that starts anew."""
        self._plans[agent].clear()

    def newest(self, agent: int, before: int, started: int | None = None) -> Plan | None:
        """Return an agent's newest plan made before a tick and, if given, started by `started`."""
        for plan in reversed(self._plans[agent]):
            if plan.tick < before and (started is None or plan.start_tick <= started):
                return plan
        return None
