"""History of a run by tick, as far as its log has been read: its messages, and the state of its links."""

from collections.abc import Iterable
from functools import cache
from typing import NamedTuple

from protocol.scenario.links import LinkChanges, words_of
from protocol.scenario.setup import Setup
from protocol.scenario.targets import target_in_words, with_targets
from protocol.wire.messages import (
    Control,
    FaultNote,
    LinkChange,
    Message,
    Plan,
    PlantState,
    Roster,
    StepReport,
    Target,
    agent_name,
)

# Kinds of messages that a history keeps.
KINDS = frozenset(kind.kind for kind in (PlantState, Plan, StepReport, LinkChange, Target, Roster, FaultNote, Control))
LOSS_WINDOW_S = 1.0  # before the shown tick, over which losses are counted


class RunHistory:
    """Messages of one run; grows while a live run is read."""

    def __init__(self, setup: Setup) -> None:
        self.begun = self.setup = self._shown = setup  # without targets, and with them
        self.plant_states: dict[int, PlantState] = {}  # by tick, which can be shown once its plant state is here
        self.first, self.last = 0, -1  # ticks from and until which can be shown
        self.plans: dict[tuple[int, int], Plan] = {}  # by agent and tick, as the reports of steps
        self.reports: dict[tuple[int, int], StepReport] = {}
        self.changes: list[LinkChange] = []  # in the order of their numbers, as the targets
        self.targets: list[Target] = []
        self.control: Control | None = None  # the coordinator's message about the end
        self.events: list[tuple[int, str]] = []  # ticks and sentences about faults, links and roster
        self._rosters: list[Roster] = []

    def add(self, messages: Iterable[Message]) -> None:
        """Add messages; skip those that do not fit the run."""
        for message in messages:
            match message:
                case PlantState() if message.x.shape == self.setup.hover.x.shape:
                    self.first = min(self.first, message.tick) if self.plant_states else message.tick
                    self.last = max(self.last, message.tick)
                    self.plant_states[message.tick] = message
                case Plan(negotiation=0):
                    self.plans[message.agent, message.tick] = message
                case StepReport():
                    self.reports[message.agent, message.tick] = message
                case LinkChange() if message.number == len(self.changes) + 1:
                    self.changes.append(message)
                    self.events.append((message.tick, words_of(message)))
                case Target() if message.number == len(self.targets) + 1:
                    self.targets.append(message)
                    self.setup = with_targets(self.setup, [message])
                    self.events.append((message.tick, target_in_words(message)))
                case Roster():
                    self._rosters.append(message)
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

    def nearest(self, tick: int) -> int:
        """Return the newest recorded tick up to `tick`, or the first one; at least one must be recorded."""
        if tick in self.plant_states:
            return tick
        return max((recorded for recorded in self.plant_states if recorded < tick), default=self.first)

    def roster(self, tick: int) -> Roster | None:
        """Return the roster at a tick; None while none is known."""
        known = [roster for roster in self._rosters if roster.tick <= tick]
        return max(known, key=lambda roster: roster.version, default=None)


class LinkState(NamedTuple):
    """One directed link between agents, 1-based, at an instant."""

    sender: int
    receiver: int
    age_s: float | None  # of the sender's newest plan that the receiver used; None if it used none or made no step
    loss: float  # share of the sender's plans of the last `LOSS_WINDOW_S` that the link lost, 0..1


class LinkHistory:
    """Link states of one run. Losses are drawn again from the scenario, whose random generator is counter-based."""

    def __init__(self, history: RunHistory) -> None:
        setup = history.setup
        self._history, self._period_s = history, setup.settings.sampling_period_s
        self._links = {
            (a, b): setup.link(agent_name(a), agent_name(b)) for a in setup.agents for b in setup.agents if a != b
        }
        self._changes, self._applied = LinkChanges(self._links.values()), 0
        self._window = max(1, round(LOSS_WINDOW_S / self._period_s))

        @cache
        def is_lost(ends: tuple[int, int], tick: int) -> bool:
            return not self._links[ends].delays(tick)

        self._is_lost = is_lost

    def states(self, tick: int) -> tuple[LinkState, ...]:
        """Return the state of every directed link at a tick."""
        for change in self._history.changes[self._applied :]:
            self._changes.apply(change)
            self._applied += 1
            self._is_lost.cache_clear()
        ages = {
            (peer, receiver): age * self._period_s
            for receiver in self._history.begun.agents
            if (report := self._history.reports.get((receiver, tick))) is not None
            for peer, age in zip(report.peers, report.plan_ages, strict=True)
            if age >= 0
        }
        # The plan of tick k has not arrived yet.
        ticks = range(max(0, tick - self._window), max(1, tick))
        lost = {ends: sum(self._is_lost(ends, k) for k in ticks) / len(ticks) for ends in self._links}
        return tuple(LinkState(*ends, ages.get(ends), loss) for ends, loss in lost.items())

    def settings(self, sender: int, receiver: int, tick: int) -> tuple[float, float]:
        """Return fixed delay, s, and loss, 0..1, of a link for the plan of a tick."""
        section = self._links[sender, receiver].impairments(tick)
        return section.delay_s, section.loss
