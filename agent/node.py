"""An agent as a state machine: one measurement in, one plan out.

A measurement opens its tick k. In lockstep the agent then waits for the plans of tick k - 1 that the
coordinator received, as they may still be on their way. With several iterations of negotiation it
next exchanges proposals with the others, and only then sends its plan. In real time it does not
wait: when it is free it uses the messages that are here, and of several measurements the newest.

Where the team is to go is `agent.planning.followed_path`; this file says what a step waits for.
"""

from collections.abc import Callable, Sequence
from typing import Any

from transport.agent.communication.clock_offsets import Clocks
from transport.agent.communication.radio import AirNews
from transport.agent.estimation.filter.belief import Belief
from transport.agent.planner import PROJECT, AgentPlanner, OpenStep
from transport.agent.planning.alone_planner import ALONE, AlonePlanner
from transport.agent.planning.followed_path import FollowedPath
from transport.agent.planning.mpc_planner import Planner
from transport.agent.received import Received
from transport.protocol.admission.delayed_messages import Arrivals
from transport.protocol.admission.participant import Participant
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import (
    Airtime,
    Measurement,
    Message,
    Plan,
    Roster,
    Target,
)
from transport.protocol.wire.names import agent_name


def planner_of(setup: TeamRun, agent: int, stopwatch: Callable[[], int]) -> AgentPlanner[Any]:
    """Return the planner of an agent, 1-based, by `agents.controller`."""
    controller = setup.known.controllers[agent - 1]
    if controller == PROJECT:
        return Planner(setup, agent, stopwatch)
    if controller == ALONE:
        return AlonePlanner(setup, agent, stopwatch)
    # Imported where it is used: other agents start without it.
    from transport.agent.user_class.user_planner import OwnPlanner

    return OwnPlanner(setup, agent, stopwatch)


class AgentNode(Participant):
    """One agent, 1-based, of a run.

    The stopwatch counts ns of a steady clock, for the step report only.
    """

    def __init__(
        self,
        setup: TeamRun,
        agent: int,
        incarnation: int = 0,
        stopwatch: Callable[[], int] = lambda: 0,
    ) -> None:
        setup = setup.by_clock_of(agent)
        self._clocks = Clocks(
            setup.rules.clock.offsets_s or (),
            agent,
            setup.settings.sampling_period_s,
            setup.system.gravity,
        )
        self._agent = agent
        self._stopwatch = stopwatch
        self._planner = planner_of(setup, agent, stopwatch)
        self._path = FollowedPath(setup, agent, self._planner)
        radio = setup.known.radio
        self._air = None if radio is None else AirNews(agent, radio)
        self._hears_by_radio = self._air is not None
        super().__init__(setup.rules, agent_name(agent), incarnation, after=1, own=agent)

    def _begin(self, incarnation: int) -> None:
        super()._begin(incarnation)
        self._measurements: Arrivals[Measurement] = Arrivals(
            self._links, after=0, speed=self._speed
        )
        self._measurement: Measurement | None = None  # of the open tick, until its step begins
        self._step: OpenStep | None = None  # being negotiated
        # Proposals of the others by tick and iterations still to come, then by agent.
        self._proposals: dict[tuple[int, int], dict[int, Plan]] = {}

    @property
    def wake_ns(self) -> int | None:
        """Time of the next poll, ns: 0, at once, in real time with a measurement; else None."""
        measurement = self._measurement
        is_due = measurement is not None and self._has_roster_of(measurement)
        return 0 if is_due and not self._waits else None

    @property
    def belief(self) -> Belief | None:
        """Newest estimate with its covariance; None without one."""
        return self._planner.belief

    def warm_up(self) -> None:
        """Prepare, so that the first step of the run is not slower than the others."""
        self._planner.warm_up()

    def poll(self, now_ns: int) -> Sequence[Message]:
        """In real time, plan from the newest measurement, after all received messages."""
        return self._work(now_ns, polled=True)

    def check_moment(self, message: Message) -> None:
        """Refuse also a measurement sent before this start of the agent was put on the roster.

        Raises: MessageError: with the reason.
        """
        super().check_moment(message)
        is_off_roster = self._agent not in self._membership.since
        if not isinstance(message, Measurement) or not is_off_roster:
            return
        if message.roster <= self._membership.version:
            reason = f"measurement of tick {message.tick}, without this start on the roster"
            raise MessageError("past", reason)

    # Messages that arrive.

    def _follow_target(self, target: Target) -> None:
        self._path.tell(target)

    def _take(self, message: Message, now_ns: int) -> None:
        if isinstance(message, Measurement):
            self._measurement = message
            self._measurements.put(message, now_ns)
        elif isinstance(message, Airtime) and self._air is not None:
            self._air.take(message, self._plans)

    def _take_plan(self, plan: Plan, now_ns: int) -> None:
        if plan.tick < self._membership.since[self._agent]:
            return
        if self._air is not None:
            plan = self._air.heard_plan(plan)
        super()._take_plan(plan, now_ns)
        if plan.negotiation > 0:
            iteration = (plan.tick, plan.negotiation)
            self._proposals.setdefault(iteration, {})[plan.agent] = plan

    def _enlist(self, roster: Roster) -> list[Plan]:
        """Take in a roster and return the plans that were ahead of it."""
        membership = self._membership
        was_on_it = membership.incarnations.get(self._agent) == self.incarnation
        waiting = membership.update(roster)
        is_on_it = membership.incarnations.get(self._agent) == self.incarnation
        if was_on_it and not is_on_it:
            # Its information may be outdated, so it comes back as a new process.
            self._planner.restart()
            self._path.return_to_roster(roster.tick)
            self._begin(self.incarnation + 1)
        return waiting

    def _end(self) -> Sequence[Message]:
        return self._planner.end(max(self._tick, 0), self._out)

    # Work on the open tick.

    def _work(self, now_ns: int, *, polled: bool = False) -> list[Message]:
        """Begin the open tick and negotiate as far as the messages received allow."""
        out: list[Message] = []
        if not self._waits and not polled:
            return out

        measurement = self._measurement
        if (
            measurement is not None
            and self._step is None
            and self._has_roster_of(measurement)
            and self._has_plans_for(measurement)
        ):
            self._measurement = None
            out += self._open(measurement, now_ns)
            out += self._plan()
        while self._step is not None and self._has_proposals_for(self._step):
            self._planner.adopt(self._step, self._take_proposals(self._step))
            out += self._plan()
        return out

    def _open(self, measurement: Measurement, now_ns: int) -> list[Message]:
        """Begin the step of a measurement's tick, on the path with the newest targets."""
        self._tick = measurement.tick
        received = self._received(measurement, now_ns)
        notes = self._path.begin(received, self._membership.since, self._out)
        self._step = self._planner.begin(received)
        return notes

    def _plan(self) -> list[Message]:
        """Return the next proposal of the open step, or its plan and report, which conclude it."""
        step = self._step
        messages = self._planner.plan(step, self._out, self.publish_ns)
        if step is not None and step.negotiation == 0:
            self._step = None
        return self._path.with_targets(messages, self._tick)

    def _received(self, measurement: Measurement, now_ns: int) -> Received:
        """Return the information for a measurement's tick; forget earlier messages."""
        started_ns = self._stopwatch()
        k = measurement.tick
        membership = self._membership

        # The simulated link decides when a message may be used, and in which order, not its arrival
        # at this process.
        plans, lost_plans = self._plans.take(k, now_ns)
        measurements, lost_measurements = self._measurements.take(k, now_ns)
        self._forget_before(k)

        roster = membership.at(measurement.roster)
        return Received(
            measurement=measurement,
            measurements=measurements,
            plans=[self._clocks.seen(plan) for plan in plans],
            lost=lost_plans,
            measurements_lost=lost_measurements,
            agents=frozenset(roster.agents),
            off=frozenset(uav - 1 for uav in roster.off),
            released=frozenset(uav - 1 for uav in roster.released),
            failed_since=membership.failed_since,
            ticks_since_start=k - membership.since.get(self._agent, 0),
            started_ns=started_ns,
        )

    def _forget_before(self, tick: int) -> None:
        """Forget arrivals and proposals of earlier ticks."""
        self._arrived = {k: agents for k, agents in self._arrived.items() if k >= tick}
        self._proposals = {
            iteration: proposals
            for iteration, proposals in self._proposals.items()
            if iteration[0] >= tick
        }
        if self._air is not None:
            self._air.forget_before(tick)

    def _has_roster_of(self, measurement: Measurement) -> bool:
        """Return whether the roster is here that a measurement names: it may come later."""
        return measurement.roster <= self._membership.version

    def _has_plans_for(self, measurement: Measurement) -> bool:
        """Return whether the shared plans of the tick before are here; real time does not wait."""
        membership = self._membership
        before = measurement.tick - 1
        if not self._waits:
            return True
        if self._air is not None and self._air.tick < measurement.tick:
            return False
        if before < membership.since.get(self._agent, 0):
            return True  # plans of ticks before this process took part are not for it
        senders = set(measurement.shared) & membership.took_part(before)
        return senders - {self._agent} <= self._arrived.get(before, set())

    def _has_proposals_for(self, step: OpenStep) -> bool:
        """Return whether the proposals of the present iteration are here from all others."""
        others = self._membership.incarnations.keys() - {self._agent}
        iteration = (step.received.tick, step.negotiation)
        if self._air is not None and not self._air.is_decided(iteration):
            return False
        return others <= self._proposals.get(iteration, {}).keys()

    def _take_proposals(self, step: OpenStep) -> list[Plan]:
        """Return the others' proposals of an iteration that pass without delay, by agent."""
        k = step.received.tick
        proposals = self._proposals.pop((k, step.negotiation), {})
        senders = sorted(proposals)
        if self._air is not None:
            heard = self._air.heard((k, step.negotiation))
            senders = [agent for agent in senders if agent in heard]
        plans = [proposals[agent] for agent in senders]
        immediate = [plan for plan in plans if self._is_immediate(plan, k, step.negotiation)]
        return [self._clocks.seen(plan) for plan in immediate]

    def _is_immediate(self, plan: Plan, k: int, negotiation: int) -> bool:
        """Return whether a proposal's link passes a copy of it without delay."""
        return 0.0 in self._plans.links[plan.sender].delays(k, negotiation)
