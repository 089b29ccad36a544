"""The common part of agents and plant: roster, links, targets, the plans that arrive, and the end of the run."""

from collections.abc import Sequence

from protocol.admission.arrivals import Arrivals
from protocol.admission.membership import Membership
from protocol.scenario.links import LinkChanges
from protocol.scenario.setup import Setup
from protocol.scenario.targets import check_target, headed
from protocol.wire.messages import Control, Event, LinkChange, Message, Plan, Presence, Roster, Target
from protocol.wire.names import COORDINATOR, PLANT, agent_name
from protocol.wire.node import Outbox, lost


class Participant:
    """A node that follows the coordinator; plans of others may be used `after` so many ticks over a perfect link."""

    publish_ns = 0

    def __init__(self, setup: Setup, name: str, incarnation: int, after: int, own: int | None = None) -> None:
        self.name, self._after = name, after
        self.finished: Control | None = None
        self._setup, self._membership = setup, Membership(own)
        self._waits = setup.scenario.clock.mode == "lockstep"
        self._speed = None if self._waits else setup.scenario.clock.speed
        self._begin(incarnation)

    def _begin(self, incarnation: int) -> None:
        """Start anew under an incarnation; only the roster is kept."""
        setup, self.incarnation = self._setup, incarnation
        self._out, self._tick = Outbox(self.name, incarnation), -1  # the newest worked on
        senders = [name for name in (*map(agent_name, setup.agents), PLANT) if name != self.name]
        self._links = {name: setup.link(name, self.name) for name in senders}
        self._link_changes = LinkChanges(self._links.values())
        self._plans: Arrivals[Plan] = Arrivals(self._links, after=self._after, speed=self._speed)
        self._arrived: dict[int, set[int]] = {}  # agents whose plans are physically here, by tick

    def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
        """Take in an event, and work as far as the messages received allow."""
        match event:
            case Message():
                self._handle(event, now_ns)
            case Presence(alive=False) if event.name == COORDINATOR:
                self.finished = lost(self._out, self._tick, "coordinator is gone")
        return self._work(now_ns) if self.finished is None else self._end()

    def _handle(self, message: Message, now_ns: int) -> None:
        match message:
            case Control():
                self.finished = message
            case Roster():
                for plan in self._enlist(message):
                    self._handle(plan, now_ns)
            case LinkChange():
                self._link_changes.apply(message)
            case Target():
                if message.number == len(self._setup.maneuver.targets) + 1:
                    self._setup = headed(self._setup, message)
                    self._head(message)
            case Plan():
                if self._membership.admits(message):
                    self._take_plan(message, now_ns)
            case _:
                self._take(message, now_ns)

    def check_moment(self, message: Message) -> None:
        """Raise MessageError for plans of earlier starts, and impossible changes."""
        match message:
            case LinkChange():
                self._link_changes.check(message)
            case Target():
                check_target(self._setup, message)
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

    def _head(self, target: Target) -> None:
        """Follow a target that the run has from now on."""

    def _take(self, message: Message, now_ns: int) -> None:
        """Take in a message of the kinds that only this node uses."""

    def _work(self, now_ns: int) -> Sequence[Message]:
        """Work as far as the messages received allow."""
        raise NotImplementedError

    def _end(self) -> Sequence[Message]:
        """Return the last messages, at the end of the run."""
        return ()
