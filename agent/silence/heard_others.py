"""The others as one agent has heard them: how old their information is, and how much each acts alone.

Information counts from the last solved step of their sender: an agent that goes on sending without solving is
silent. Source: docs/equations.md (32c), (63c).
"""

from collections.abc import Iterable

from transport.agent.received import ReceivedPlans
from transport.agent.silence.age_of_information import NO_WAIT, InformationAge, InformationAges
from transport.agent.silence.silence_thresholds import Silence
from transport.protocol.wire.messages import Plan

# Tick of an event that has not occurred: before the first.
NEVER = -1


class HeardOthers:
    """Plans of all agents, and the ages of those of the others.

    Where a method takes a tick `before`, only plans made before it count, even if later ones have
    been received; where it takes a plan, that is the agent's newest one, for a past tick the newest that
    had started, or None without any.

    Args:
        agents: Numbers of the agents, 1-based.
        own: The agent itself; 0 for none.
        silence: Rule by which agents act alone as their information gets old; None: they never do.
        after_failures: The rule from a failure of a UAV on.

    Attributes:
        off_roster: Agents that make no more plans.
        failed_since: Tick of the newest failure of a UAV, or `NEVER`.
        plans: Plans received.
        oldest_information: Largest mean and largest overdue age at the tick last observed, not necessarily
            of one agent.
    """

    def __init__(
        self,
        agents: Iterable[int],
        own: int,
        silence: Silence | None = None,
        after_failures: Silence | None = None,
    ) -> None:
        self.off_roster: set[int] = set()
        self.failed_since = NEVER
        self._agents = tuple(agents)
        self._own = own
        self._silence = silence
        self._after_failures = after_failures

        self.plans = ReceivedPlans(self._agents)
        self._peers = tuple(agent for agent in self._agents if agent != own)
        self._ages = InformationAges(self._peers)
        if silence is not None:
            self._ages = InformationAges(self._peers, silence.window, silence.recent)
        self.oldest_information = NO_WAIT

        # The first tick at which information was observed, and that at which an agent returned: from these
        # on its plans are expected.
        self._began: int | None = None
        self._returned: dict[int, int] = {}

    def begin_anew(self, agent: int, tick: int) -> None:
        """Discard the plans of an agent that returns at a tick, and how old they were."""
        self.plans.forget(agent)
        self._returned[agent] = tick
        if agent != self._own:
            self._ages.forget(agent)

    @property
    def silence(self) -> Silence | None:
        """Rule by which agents act alone; None: they never do."""
        has_failures = self.failed_since != NEVER
        return self._after_failures if has_failures else self._silence

    # Ages of information.

    def observe(self, k: int) -> None:
        """Take in how old the newest plans of the others are, and their largest ages.

        To be called once a tick, after its plans are added. Without a rule by which agents act alone
        nothing depends on ages, and none are taken.
        """
        if self.silence is None:
            return
        if self._began is None:
            self._began = k
        mean = 0.0
        overdue = 0.0
        for agent in self._peers:
            plan = self.plans.newest(agent, before=k)
            if plan is not None:
                self._ages.observe(agent, k - plan.solved_tick)
            age = self.age(agent, plan, k)
            mean = max(mean, age.mean)
            overdue = max(overdue, age.overdue)
        self.oldest_information = InformationAge(mean=mean, overdue=overdue)

    def age(self, agent: int, plan: Plan | None, tick: int) -> InformationAge:
        """Return how old the information about an agent is at a tick, also for past ticks by those of now."""
        if agent == self._own or agent in self.off_roster:
            return NO_WAIT
        # Without any plan, as if one had been made just before the first that can be expected.
        newest = self._expected_since(agent) - 1 if plan is None else plan.solved_tick
        overdue = max(0.0, float(tick - newest - self._ages.usual(agent)))
        return InformationAge(mean=self._ages.mean(agent), overdue=overdue)

    def _expected_since(self, agent: int) -> int:
        """Return the tick from which on plans of an agent are expected."""
        return self._returned.get(agent, self._began or 0)

    def is_informed(self, tick: int, before: int) -> bool:
        """Return whether the inputs of all others at a tick are as well known as usual: (41)."""
        silence = self.silence
        if silence is None:
            return True
        for agent in self._peers:
            plan = self.plans.newest(agent, before, started=tick)
            if self.age(agent, plan, tick).overdue > silence.uninformed:
                return False
        return True

    def lacks_first_information(self, before: int) -> bool:
        """Return whether the agent began in mid-run, and has not heard one of the others since."""
        began_in_mid_run = self._began is not None and self._began > 0
        return began_in_mid_run and not self.has_heard_all(before)

    def has_heard_all(self, before: int) -> bool:
        """Return whether there is a plan of each of the others on the roster.

        Of those that have returned it has to hear nothing: they hear the team first.
        """
        present = set(self._agents) - self.off_roster - self._returned.keys() - {self._own}
        return all(self.plans.newest(agent, before) is not None for agent in present)

    # How much the others act alone.

    def share_alone(self, agent: int, plan: Plan | None, tick: int) -> float:
        """Return how much an agent is assumed to act alone at a tick.

        The larger of what its plan says and of what follows from the age of its information.
        """
        silence = self.silence
        if silence is None:
            return 0.0
        return alone_by(silence, plan, self.age(agent, plan, tick))

    def most_said(self, before: int) -> float:
        """Return the largest share of acting alone that the newest plan of one of the others announces.

        0 without plans of others on the roster. An agent that has just returned was alone as the team
        flew on without it, and is on its way back: it does not count.
        """
        most = 0.0
        for agent in self._peers:
            plan = self.plans.newest(agent, before)
            if plan is None or agent in self.off_roster:
                continue
            if not self._is_returning(agent, plan):
                most = max(most, plan.alone)
        return most

    def _is_returning(self, agent: int, plan: Plan) -> bool:
        """Return whether a plan is from the time in which a returned agent hands over to the team."""
        silence = self.silence
        returned = self._returned.get(agent)
        if silence is None or returned is None:
            return False
        return plan.tick < returned + silence.to_team

    # Agents without any plan.

    def has_returned(self, agent: int) -> bool:
        """Return whether an agent was off the roster, and has returned."""
        return agent in self._returned

    def is_before_return(self, agent: int, tick: int) -> bool:
        """Return whether an agent was off the roster at a tick, and has returned since."""
        return tick < self._returned.get(agent, 0)

    def acts_without_plan(self, agent: int, tick: int) -> bool:
        """Return whether an agent is assumed to act at a tick although it has sent no plan yet."""
        silence = self.silence
        if silence is None:
            return False
        return self.age(agent, None, tick).overdue > silence.overdue.begins


def alone_by(silence: Silence, plan: Plan | None, age: InformationAge) -> float:
    """Return the larger share alone of what a plan says and of what follows from its age."""
    said = 0.0 if plan is None else plan.alone
    return max(said, silence.alone(age))
