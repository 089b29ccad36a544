"""An agent as a state machine: one measurement in, one plan out.

A measurement opens its tick. In lockstep the agent then waits for the plans of the tick before that the clock waited
for (they may still be on their way), plans, and answers; with several iterations of negotiation it exchanges plans with
the others within the tick before that. In real time it does not wait: it uses the messages received by the time it is
free, and of several measurements the newest.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from agent.alone import ALONE, AlonePlanner, AloneStep
from agent.kalman import Belief
from agent.own import PROJECT, OwnPlanner, OwnStep
from agent.step import Planner, Step
from agent.team_estimate import Known
from protocol.admission.arrivals import Arrivals
from protocol.admission.participant import Participant
from protocol.scenario.setup import Setup
from protocol.wire.errors import MessageError
from protocol.wire.messages import Measurement, Message, Plan, Roster, Target
from protocol.wire.names import agent_name


class AgentNode(Participant):
    """One agent, 1-based, of a run; the stopwatch counts ns of a steady clock, for the step report only."""

    def __init__(
        self, setup: Setup, agent: int, incarnation: int = 0, stopwatch: Callable[[], int] = lambda: 0
    ) -> None:
        self._agent, self._stopwatch = agent, stopwatch
        planners: dict[str, Any] = {PROJECT: Planner, ALONE: AlonePlanner}
        self._planner: Any = planners.get(setup.scenario.agents.controller, OwnPlanner)(setup, agent, stopwatch)
        self._targets: deque[tuple[int, Setup]] = deque()  # those still to come: the tick, the run with it
        super().__init__(setup, agent_name(agent), incarnation, after=1, own=agent)

    def _begin(self, incarnation: int) -> None:
        super()._begin(incarnation)
        self._measurements: Arrivals[Measurement] = Arrivals(self._links, after=0, speed=self._speed)
        self._measurement: Measurement | None = None  # of the open tick, until its step begins
        self._step: Step | OwnStep | AloneStep | None = None  # being negotiated
        self._proposals: dict[tuple[int, int], dict[int, Plan]] = {}  # by tick and exchanges to come, and agent

    @property
    def wake_ns(self) -> int | None:
        """Time of the next poll: in real time at once when a measurement is here, else none."""
        return 0 if self._measurement is not None and not self._waits else None

    def poll(self, now_ns: int) -> Sequence[Message]:
        """In real time, plan from the newest measurement once all received messages are taken in."""
        return self._work(now_ns, polled=True)

    @property
    def belief(self) -> Belief | None:
        """Newest belief of the Kalman filter; None without one."""
        return self._planner.belief if isinstance(self._planner, Planner) else None

    def warm_up(self) -> None:
        """Compute a step and discard it, so that the first step of the run is not slower than the others."""
        self._planner.warm_up()

    def _head(self, target: Target) -> None:
        self._targets.append((target.tick, self._setup))

    def _take(self, message: Message, now_ns: int) -> None:
        if isinstance(message, Measurement):
            self._measurement = message
            self._measurements.put(message, now_ns)

    def _take_plan(self, plan: Plan, now_ns: int) -> None:
        if plan.tick < self._membership.since[self._agent]:
            return
        super()._take_plan(plan, now_ns)
        if plan.negotiation > 0:
            self._proposals.setdefault((plan.tick, plan.negotiation), {})[plan.agent] = plan

    def _end(self) -> Sequence[Message]:
        last: Sequence[Message] = self._planner.end(max(self._tick, 0), self._out)
        return last

    def check_moment(self, message: Message) -> None:
        """Refuse also measurements of earlier starts. Raises: MessageError: with the reason."""
        super().check_moment(message)
        membership = self._membership
        is_off = self._agent not in membership.since
        if isinstance(message, Measurement) and is_off and message.roster <= membership.version:
            raise MessageError("past", f"measurement of tick {message.tick}, without this start on the roster")

    def _enlist(self, roster: Roster) -> list[Plan]:
        """Take in a roster and return the plans that were ahead of it."""
        was_on_it = self._membership.incarnations.get(self._agent) == self.incarnation
        waiting = self._membership.update(roster)
        if was_on_it and self._membership.incarnations.get(self._agent) != self.incarnation:
            # Taken off the roster: its information may be outdated, so it comes back as a new process.
            self._planner.restart()
            self._begin(self.incarnation + 1)
        return waiting

    def _work(self, now_ns: int, *, polled: bool = False) -> list[Message]:
        """Begin the open tick and continue its negotiation as far as the messages received allow."""
        out: list[Message] = []
        if not self._waits and not polled:
            return out
        if self._measurement is not None and self._step is None and self._has_plans_for(self._measurement):
            measurement, self._measurement = self._measurement, None
            self._tick = measurement.tick
            followed = None
            while self._targets and self._targets[0][0] <= self._tick:
                followed = self._targets.popleft()[1]
            if followed is not None:
                self._planner.head(followed)
            self._step = self._planner.begin(self._known(measurement, now_ns))
            out += self._plan(self._step)
        while self._step is not None and self._has_proposals_for(self._step):
            self._planner.adopt(self._step, self._take_proposals(self._step))
            out += self._plan(self._step)
        return out

    def _plan(self, step: Step | OwnStep | AloneStep) -> list[Message]:
        """Return the next proposal of a step, or its plan and report, which conclude it."""
        messages: list[Message] = self._planner.plan(step, self._out, self.publish_ns)
        if step.negotiation == 0:
            self._step = None
        return messages

    def _known(self, measurement: Measurement, now_ns: int) -> Known:
        """Return the information for a measurement's tick, and forget the messages of earlier ticks."""
        started_ns = self._stopwatch()
        k, membership = measurement.tick, self._membership
        # A message is usable when its link says so, even if it is here earlier, and in an order of its own.
        plans, lost_plans = self._plans.take(k, now_ns)
        self._arrived = {tick: agents for tick, agents in self._arrived.items() if tick >= k}
        self._proposals = {at: proposals for at, proposals in self._proposals.items() if at[0] >= k}
        roster = membership.at(measurement.roster)
        return Known(
            measurement=measurement,
            measurements=self._measurements.take(k, now_ns)[0],
            plans=plans,
            lost=lost_plans,
            agents=frozenset(roster.agents),
            off=frozenset(uav - 1 for uav in roster.off),
            released=frozenset(uav - 1 for uav in roster.released),
            failed_since=membership.failed_since,
            ticks_since_start=k - membership.since.get(self._agent, 0),
            started_ns=started_ns,
        )

    def _take_proposals(self, step: Step | OwnStep | AloneStep) -> list[Plan]:
        """Return the others' proposals of the present iteration that their links pass without delay, by agent."""
        k = step.known.measurement.tick
        proposals = sorted(self._proposals.pop((k, step.negotiation), {}).items())
        links = self._plans.links
        return [plan for _, plan in proposals if 0.0 in links[plan.sender].delays(k, step.negotiation)]

    def _has_plans_for(self, measurement: Measurement) -> bool:
        """Return whether the roster is here, and the plans of the tick before from those on it that shared one."""
        if not self._waits:
            return True
        if measurement.roster > self._membership.version:
            return False
        if measurement.tick - 1 < self._membership.since.get(self._agent, 0):
            return True  # plans of ticks before this process took part are not for it
        senders = set(measurement.shared) & self._membership.took_part(measurement.tick - 1) - {self._agent}
        return senders <= self._arrived.get(measurement.tick - 1, set())

    def _has_proposals_for(self, step: Step | OwnStep | AloneStep) -> bool:
        """Return whether the proposals of the present iteration are here from all others."""
        here = self._proposals.get((step.known.measurement.tick, step.negotiation), {})
        return self._membership.incarnations.keys() - {self._agent} <= here.keys()
