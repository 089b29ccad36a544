"""History of a run by tick, as far as its log has been read: its messages, and the state of its links."""

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from protocol.scenario.links import LinkChanges, words_of
from protocol.scenario.setup import Setup
from protocol.scenario.targets import target_in_words, with_targets
from protocol.wire.messages import (
    Control,
    FaultNote,
    LinkChange,
    Message,
    MessageError,
    Plan,
    PlantState,
    Roster,
    StepReport,
    Target,
    agent_name,
)

# Kinds of messages that a history keeps.
KINDS = frozenset(kind.kind for kind in (PlantState, Plan, StepReport, LinkChange, Target, Roster, FaultNote, Control))
# Time before the shown tick over which losses are counted, s.
LOSS_WINDOW_S = 1.0


class RunHistory:
    """Messages of one run; grows while a live run is read.

    Attributes:
        plant_states: Plant states by tick; a tick can be shown once its plant state is here.
        first: First tick that can be shown, 0 if there is none.
        last: Last tick that can be shown, -1 if there is none.
        changes: Link changes in the order of their numbers, without duplicates.
        targets: Targets in the order of their numbers, without duplicates.
        begun, setup: The run without them, and with them.
        control: The coordinator's message about the end of the run, once it has ended.
        events: Sentences about faults, links and roster, each with its tick.
    """

    def __init__(self, setup: Setup) -> None:
        self.begun = self.setup = self._shown = setup
        self.targets: list[Target] = []
        self.plant_states: dict[int, PlantState] = {}
        self.first, self.last = 0, -1
        self.changes: list[LinkChange] = []
        self.control: Control | None = None
        self.events: list[tuple[int, str]] = []
        self._reports: dict[tuple[int, int], StepReport] = {}
        self._plans: dict[tuple[int, int], Plan] = {}
        self._rosters: list[tuple[int, Roster]] = []

    def add(self, messages: Iterable[Message]) -> None:
        """Add messages; skip those that do not fit the run."""
        for message in messages:
            match message:
                case PlantState() if message.x.shape == self.setup.hover.x.shape:
                    self.first = min(self.first, message.tick) if self.plant_states else message.tick
                    self.last = max(self.last, message.tick)
                    self.plant_states[message.tick] = message
                case Plan(negotiation=0):
                    self._plans[message.agent, message.tick] = message
                case StepReport():
                    self._reports[message.agent, message.tick] = message
                case LinkChange() if message.number == len(self.changes) + 1:
                    self.changes.append(message)
                    self.events.append((message.tick, words_of(message)))
                case Target() if message.number == len(self.targets) + 1:
                    self.targets.append(message)
                    self.setup = with_targets(self.setup, [message])
                    self.events.append((message.tick, target_in_words(message)))
                case Roster():
                    self._rosters.append((message.tick, message))
                    if message.version > 1 and not message.reason.startswith(("links ", "target (")):
                        self.events.append((message.tick, message.reason))
                case FaultNote():
                    self.events.append((message.tick, f"{message.target} {message.what}"))
                case Control():
                    self.control = message

    def setup_at(self, tick: int) -> Setup:
        """Return the run with the targets that are known at a tick."""
        known = [target for target in self.targets if target.tick <= tick]
        if len(known) < len(self._shown.maneuver.targets):
            self._shown = self.begun
        self._shown = with_targets(self._shown, known)
        return self._shown

    def plan(self, agent: int, tick: int) -> Plan | None:
        """Return the plan an agent made at a tick, if there is one."""
        return self._plans.get((agent, tick))

    def report(self, agent: int, tick: int) -> StepReport | None:
        """Return an agent's report of a tick, if there is one."""
        return self._reports.get((agent, tick))

    def nearest(self, tick: int) -> int:
        """Return the newest recorded tick up to `tick`, or the first one; at least one must be recorded."""
        if tick in self.plant_states:
            return tick
        ticks = sorted(self.plant_states)
        return ticks[max(0, bisect_right(ticks, tick) - 1)]

    def members(self, tick: int) -> frozenset[int]:
        """Return the agents on the roster at a tick; all agents while no roster is known."""
        roster = self._roster(tick)
        return frozenset(self.setup.agents if roster is None else roster.agents)

    def released(self, tick: int) -> tuple[int, ...]:
        """Return the UAVs, 1-based, that have left their rods by a tick."""
        roster = self._roster(tick)
        return () if roster is None else tuple(roster.released)

    def is_whole(self, tick: int) -> bool:
        """Return whether every agent is on the roster and every UAV has its motors at a tick."""
        roster = self._roster(tick)
        return roster is None or (set(roster.agents) == set(self.setup.agents) and not roster.off)

    def _roster(self, tick: int) -> Roster | None:
        known = [roster for since, roster in self._rosters if since <= tick]
        return max(known, key=lambda roster: roster.version, default=None)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkState:
    """One directed link between agents at an instant.

    Attributes:
        sender, receiver: Agents, 1-based.
        age_s: Age of the sender's newest plan that the receiver used, s; None if it used none or made no step.
        loss: Share of the sender's plans of the last `LOSS_WINDOW_S` that the link lost, 0..1.
    """

    sender: int
    receiver: int
    age_s: float | None
    loss: float


class LinkHistory:
    """Link states of one run. Losses are drawn again from the scenario, whose random generator is counter-based."""

    def __init__(self, setup: Setup) -> None:
        self._period_s = setup.settings.sampling_period_s
        self._links = {
            (sender, receiver): setup.link(agent_name(sender), agent_name(receiver))
            for sender in setup.agents
            for receiver in setup.agents
            if sender != receiver
        }
        self._changes = LinkChanges(self._links.values(), setup.samples_s)
        self._window = max(1, round(LOSS_WINDOW_S / self._period_s))
        self._lost: dict[tuple[int, int, int], bool] = {}

    def change(self, message: LinkChange) -> None:
        """Apply a link change; ignore a malformed one."""
        try:
            self._changes.apply(message)
        except MessageError:
            return
        self._lost = {key: lost for key, lost in self._lost.items() if key[2] < message.tick}

    def states(self, tick: int, reports: Sequence[StepReport]) -> tuple[LinkState, ...]:
        """Return the state of every directed link at a tick, given the reports of the agents of that tick."""
        ages = {
            (peer, report.agent): age * self._period_s
            for report in reports
            for peer, age in zip(report.peers, report.plan_ages, strict=True)
            if age >= 0
        }
        # The plan of tick k has not arrived yet.
        ticks = range(max(0, tick - self._window), max(1, tick))
        return tuple(
            LinkState(
                sender=sender,
                receiver=receiver,
                age_s=ages.get((sender, receiver)),
                loss=sum(self._is_lost(sender, receiver, k) for k in ticks) / len(ticks),
            )
            for sender, receiver in self._links
        )

    def settings(self, sender: int, receiver: int, tick: int) -> tuple[float, float]:
        """Return fixed delay, s, and loss, 0..1, of a link for the plan of a tick."""
        section = self._links[sender, receiver].impairments(tick)
        return section.delay_s, section.loss

    def _is_lost(self, sender: int, receiver: int, tick: int) -> bool:
        key = (sender, receiver, tick)
        if key not in self._lost:
            self._lost[key] = not self._links[sender, receiver].delays(tick)
        return self._lost[key]
