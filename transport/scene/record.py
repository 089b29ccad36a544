"""What a scene is made of: a run's messages by tick, as many as have been read so far."""

from bisect import bisect_right
from collections.abc import Iterable

from protocol.scenario.setup import Setup
from protocol.wire.messages import Control, FaultNote, LinkChange, Message, Plan, PlantState, Roster, StepReport
from transport.log.tail import Unread

# The kinds of messages that a record takes in; of others nothing is shown.
KINDS = frozenset(kind.kind for kind in (PlantState, Plan, StepReport, LinkChange, Roster, FaultNote, Control))
# Those that are most of a log, and of which those of few ticks are shown: a tail may leave them for later.
LATER = frozenset(kind.kind for kind in (Plan, StepReport))


class Record:
    """The messages of one run; grows as a log does that is read while it is written.

    Args:
        setup: The run as it is flown.

    Attributes:
        plant_states: The plant's states by tick; a tick can be shown once its truth is here.
        first: The first tick that can be shown, 0 when there is none.
        last: The newest tick that can be shown, -1 when there is none.
        changes: Changes of links in the order of their numbers, each once.
        control: How the run ended, once it has.
        news: Sentences about faults and the roster, each with its tick.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self.plant_states: dict[int, PlantState] = {}
        self.first, self.last = 0, -1
        self.changes: list[LinkChange] = []
        self.control: Control | None = None
        self.news: list[tuple[int, str]] = []
        self._reports: dict[tuple[int, int], StepReport | Unread] = {}
        self._plans: dict[tuple[int, int], Plan | Unread] = {}
        self._rosters: list[tuple[int, Roster]] = []

    def add(self, messages: Iterable[Message | Unread]) -> None:
        """Take in messages; what cannot be of this run is left out."""
        for message in messages:
            match message:
                case PlantState() if message.x.shape == self._setup.hover.x.shape:
                    self.first = min(self.first, message.tick) if self.plant_states else message.tick
                    self.last = max(self.last, message.tick)
                    self.plant_states[message.tick] = message
                case Plan() | Unread(kind=Plan.kind):
                    if message.negotiation == 0:
                        self._plans[message.agent, message.tick] = message
                case StepReport() | Unread(kind=StepReport.kind):
                    self._reports[message.agent, message.tick] = message
                case LinkChange() if message.number == len(self.changes) + 1:
                    self.changes.append(message)
                    self.news.append((message.tick, _said(message)))
                case Roster():
                    self._rosters.append((message.tick, message))
                    if message.version > 1 and not message.reason.startswith("links "):
                        self.news.append((message.tick, message.reason))
                case FaultNote():
                    self.news.append((message.tick, f"{message.target} {message.what}"))
                case Control():
                    self.control = message

    def plan(self, agent: int, tick: int) -> Plan | None:
        """The plan an agent made at a tick."""
        plan = self._plans.get((agent, tick))
        if isinstance(plan, Unread):
            message = plan.message()
            if not isinstance(message, Plan):
                return None
            plan = self._plans[agent, tick] = message
        return plan

    def report(self, agent: int, tick: int) -> StepReport | None:
        """How an agent's step of a tick went."""
        report = self._reports.get((agent, tick))
        if isinstance(report, Unread):
            message = report.message()
            if not isinstance(message, StepReport):
                return None
            report = self._reports[agent, tick] = message
        return report

    def nearest(self, tick: int) -> int:
        """The tick that can be shown next to one: the newest up to it, or the first; there is at least one."""
        if tick in self.plant_states:
            return tick
        ticks = sorted(self.plant_states)
        return ticks[max(0, bisect_right(ticks, tick) - 1)]

    def members(self, tick: int) -> frozenset[int]:
        """Agents on the roster at a tick; all of them as long as nothing is known."""
        roster = self._roster(tick)
        return frozenset(self._setup.agents if roster is None else roster.agents)

    def is_whole(self, tick: int) -> bool:
        """Whether at a tick every agent is on the roster and every UAV has its motors."""
        roster = self._roster(tick)
        return roster is None or (set(roster.agents) == set(self._setup.agents) and not roster.off)

    def _roster(self, tick: int) -> Roster | None:
        known = [roster for since, roster in self._rosters if since <= tick]
        return max(known, key=lambda roster: roster.version, default=None)


def _said(change: LinkChange) -> str:
    return f"links from {change.source or 'any agent'} to {change.target or 'any agent'}: {change.settings}"
