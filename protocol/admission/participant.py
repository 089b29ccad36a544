"""The common part of agents, plant and vehicles: instants, links, targets, arriving plans, end of the run."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from transport.protocol.admission.delayed_messages import Arrivals
from transport.protocol.admission.membership import Membership
from transport.protocol.scenario.links.link_changes import LinkChanges
from transport.protocol.scenario.setup.run_rules import RunRules
from transport.protocol.wire.errors_and_exit_codes import MessageError
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
from transport.protocol.wire.outbox import Outbox, end_without_coordinator


@dataclass(frozen=True, slots=True, kw_only=True)
class Ticking:
    """Tick k is at `start_ns` + k T_s / speed; times are ns of a steady clock of this process."""

    start_ns: int
    period_ns: int
    speed: float

    @staticmethod
    def of(schedule_ns: int, period_ns: int, speed: float, wall_offset_ns: int) -> "Ticking":
        """Return the instants of a schedule, ns since 1970.

        wall_offset_ns: The common clock less the steady one of this process, ns.
        """
        return Ticking(start_ns=schedule_ns - wall_offset_ns, period_ns=period_ns, speed=speed)

    def due_ns(self, tick: float) -> int:
        """Return the instant of a tick, or of a part of one."""
        return self.start_ns + round(tick * self.period_ns / self.speed)

    def ticks(self, now_ns: int) -> float:
        """Return the ticks since tick 0, with their parts; negative before it."""
        return (now_ns - self.start_ns) * self.speed / self.period_ns

    def newest(self, now_ns: int) -> int:
        """Return the newest tick whose instant has come; -1 before the first."""
        return max(math.floor(self.ticks(now_ns)), -1)


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
