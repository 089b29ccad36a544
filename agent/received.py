"""Messages that an agent has received: those of a tick, and the newest plans of all agents."""

from bisect import bisect_left
from collections.abc import Iterable, Sequence, Set
from operator import attrgetter

import msgspec

from transport.protocol.wire.messages import Measurement, Plan

# Plans kept per agent: enough for the past inputs over any usable delay.
KEPT_PLANS = 256


class Received(msgspec.Struct, frozen=True, kw_only=True):
    """Messages and roster of a tick, as the links of the agent have delivered them."""

    measurement: Measurement  # the tick's own
    measurements: Sequence[Measurement]  # that have become usable since the last step, in order
    plans: Sequence[Plan]  # of the others, that have become usable since the last step, in order
    lost: int  # plans that are known since then to be lost on their links
    measurements_lost: int  # the same of measurements
    agents: Set[int]  # on the roster, 1-based
    off: frozenset[int]  # UAVs whose motors are off, 0-based
    released: frozenset[int]  # those of them that are released
    failed_since: int  # tick of the newest failure of a UAV
    ticks_since_start: int  # since this process joined
    started_ns: int  # begin of the step on the stopwatch

    @property
    def tick(self) -> int:
        """The present tick."""
        return self.measurement.tick


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
