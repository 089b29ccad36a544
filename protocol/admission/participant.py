"""The common part of agents and plant: roster, links, targets, arriving plans, end of the run."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from typing import Any

from transport.protocol.admission.arrivals import Arrivals
from transport.protocol.scenario.links.link_changes import LinkChanges
from transport.protocol.scenario.setup.run_rules import RunRules
from transport.protocol.wire.errors import MessageError
from transport.protocol.wire.messages import (
    Control,
    Event,
    LinkChange,
    Message,
    Plan,
    Presence,
    Roster,
    Target,
)
from transport.protocol.wire.names import (
    COORDINATOR,
    PLANT,
    VEHICLE,
    agent_name,
    role_of,
    vehicle_name,
)
from transport.protocol.wire.node_interface import Outbox, end_without_coordinator

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
        # By agent that left: its last incarnation, and the tick at which it left.
        self._left: dict[int, tuple[int, int]] = {}
        self._rosters = [_NONE]  # ascending, from the one in force on

    def took_part(self, tick: int) -> set[int]:
        """Return the agents whose plans of a tick are here or still to come.

        Also of those that have left since.
        """
        present = {agent for agent, since in self.since.items() if since <= tick}
        were_present = {agent for agent, (_, left) in self._left.items() if tick < left}
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
            self._left[agent] = (before[agent], roster.tick)
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
        incarnation, left = self._left.get(plan.agent, (-1, 0))
        return plan.incarnation == incarnation and plan.tick < left


def check_target(count: int, message: Target) -> None:
    """Raise MessageError for a target that is neither the next one after a count nor a repeated one."""
    if message.number > count + 1:
        raise MessageError("future", f"target {message.number} after {count}")


class Participant(ABC):
    """A node that follows the coordinator.

    Args:
        after: Ticks from that of a plan until others may use it, over a perfect link.
        own: Number of the agent that the node is, if it is one.
    """

    publish_ns = 0  # time that the newest messages took to publish
    _hears_by_radio = False  # whether plans come over the radio of the team

    def __init__(
        self, rules: RunRules, name: str, incarnation: int, after: int, own: int | None = None
    ) -> None:
        self.name = name
        self.finished: Control | None = None
        self._rules = rules
        self._usable_after = after
        self._membership = Membership(own)
        self._goes_on = rules.clock.on_coordinator_loss == "continue"
        self._waits = rules.clock.mode == "lockstep"
        # Scenario seconds per second; None in lockstep, where plans arrive by ticks.
        self._speed = None if self._waits else rules.clock.speed
        self._targets_told = 0
        self._begin(incarnation)

    def _begin(self, incarnation: int) -> None:
        """Start anew under an incarnation; only the roster and the targets so far are kept."""
        self.incarnation = incarnation
        self._out = Outbox(self.name, incarnation)
        self._tick = -1  # the newest worked on

        participants = (*map(agent_name, self._rules.agents), PLANT)
        senders = [name for name in participants if name != self.name]
        # A vehicle is to its agent what the plant is to all.
        own = PLANT if role_of(self.name) == VEHICLE else self.name
        self._links = {name: self._rules.link(name, own) for name in senders if name != own}
        if self._rules.has_vehicles and own != PLANT:
            for uav in range(1, self._rules.uavs + 1):
                self._links[vehicle_name(uav)] = self._links[PLANT]
        self._link_changes = LinkChanges(self._links.values())
        self._plans: Arrivals[Plan] = Arrivals(
            self._links, after=self._usable_after, speed=self._speed, aired=self._hears_by_radio
        )
        self._arrived: dict[int, set[int]] = {}  # agents whose plans are physically here, by tick

    def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
        """Take in an event, and work as far as the messages received allow."""
        match event:
            case Message():
                self._handle(event, now_ns)
            case Presence(alive=False) if event.name == COORDINATOR and not self._goes_on:
                self.finished = end_without_coordinator(
                    self._out, self._tick, "coordinator is gone"
                )
        return self._work(now_ns) if self.finished is None else self._end()

    def _handle(self, message: Message, now_ns: int) -> None:
        match message:  # what comes most is first
            case Plan():
                if self._membership.admit_or_keep(message):
                    self._take_plan(message, now_ns)
            case Control():
                self.finished = message
            case Roster():
                for plan in self._enlist(message):
                    self._handle(plan, now_ns)
            case LinkChange():
                self._link_changes.apply(message)
            case Target():
                if message.number == self._targets_told + 1:
                    self._targets_told += 1
                    self._follow_target(message)
            case _:
                self._take(message, now_ns)

    def check_moment(self, message: Message) -> None:
        """Raise MessageError for plans of earlier starts, and impossible changes."""
        match message:
            case LinkChange():
                self._link_changes.check(message)
            case Target():
                check_target(self._targets_told, message)
            case Plan():
                self._membership.check(message)

    def _enlist(self, roster: Roster) -> list[Plan]:
        """Take in a roster and return the plans that were ahead of it."""
        return self._membership.update(roster)

    def _take_plan(self, plan: Plan, now_ns: int) -> None:
        """Take in a plan, but no proposal of a negotiation, of an agent on the roster."""
        if plan.negotiation == 0:
            self._arrived.setdefault(plan.tick, set()).add(plan.agent)
            self._plans.put(plan, now_ns)

    @abstractmethod
    def _follow_target(self, target: Target) -> None:
        """Take in the next target of the coordinator, also one that this process is not told."""

    @abstractmethod
    def _take(self, message: Message, now_ns: int) -> None:
        """Take in a message of the kinds that only this node uses."""

    @abstractmethod
    def _work(self, now_ns: int) -> Sequence[Message]:
        """Work as far as the messages received allow."""

    def _end(self) -> Sequence[Message]:
        """Return the last messages, at the end of the run."""
        return ()
