"""Messages of one run that scenes need, by tick; they grow while a live run is read."""

import re
from collections.abc import Iterable
from itertools import groupby

from transport.protocol.scenario.links.link_changes import words_of
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import (
    Airtime,
    Control,
    FaultNote,
    LinkChange,
    Message,
    Plan,
    PlantState,
    Roster,
    StepReport,
    Target,
)
from transport.protocol.wire.names import PLANT

# Beginnings of the reasons of rosters that another message tells in its own words.
_TOLD_ELSEWHERE = ("links ", "all links", "target (")
# Text of a change of links: which ones, and their new settings.
_CHANGE = re.compile(r"(links (?:from \S+ to \S+|from \S+|to \S+|between agents))(: .*| cleared)")
_ONE_LINK = re.compile(r"links from \S+ to \S+")
# The links of the changes by one request for all of them.
_ALL_LINKS = {"links between agents", f"links from {PLANT}", f"links to {PLANT}"}

# Kinds of messages that a history keeps.
KINDS = frozenset(
    kind.kind
    for kind in (
        *(PlantState, Plan, StepReport, Airtime),
        *(LinkChange, Target, Roster, FaultNote, Control),
    )
)


class RunHistory:
    """Messages of one run; grows while a live run is read."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup  # with the targets so far
        # Plant states by tick; a tick can be shown once its state is here.
        self.plant_states: dict[int, PlantState] = {}
        self.first = 0  # ticks from and until which can be shown
        self.last = -1
        # Plans and reports of steps by agent and tick.
        self.plans: dict[tuple[int, int], Plan] = {}
        self.reports: dict[tuple[int, int], StepReport] = {}
        self.control: Control | None = None  # the coordinator's message about the end
        # Ticks and sentences about faults, links and roster.
        self.events: list[tuple[int, str]] = []
        self.airtimes: dict[int, list[Airtime]] = {}  # messages of the radio, by tick
        self.link_changes: list[LinkChange] = []
        self._rosters: list[Roster] = []

    def add(self, messages: Iterable[Message]) -> None:
        """Add messages; skip those that do not fit the run."""
        for message in messages:
            self._add(message)

    def _add(self, message: Message) -> None:
        """Add a message, if it fits the run."""
        match message:
            case PlantState() if message.x.shape == self.setup.hover.x.shape:
                self._add_plant_state(message)
            case Plan(negotiation=0):
                self.plans[message.agent, message.tick] = message
            case StepReport():
                self.reports[message.agent, message.tick] = message
            case Airtime():
                self.airtimes.setdefault(message.tick, []).append(message)
            case LinkChange() if message.number == len(self.link_changes) + 1:
                self.link_changes.append(message)
                self.events.append((message.tick, words_of(message)))
            case Target() if message.number == len(self.setup.maneuver.targets) + 1:
                self.setup = self.setup.after([message])
                self.events.append((message.tick, message.in_words()))
            case Roster():
                self._add_roster(message)
            case FaultNote():
                self.events.append((message.tick, f"{message.target} {message.what}"))
            case Control():
                self.control = message

    def _add_plant_state(self, state: PlantState) -> None:
        """Keep a state of the plant, and the range of ticks that can be shown."""
        self.first = min(self.first, state.tick) if self.plant_states else state.tick
        self.last = max(self.last, state.tick)
        self.plant_states[state.tick] = state

    def _add_roster(self, roster: Roster) -> None:
        """Keep a roster, and its reason as an event unless another message tells it."""
        self._rosters.append(roster)
        if roster.version > 1 and not roster.reason.startswith(_TOLD_ELSEWHERE):
            self.events.append((roster.tick, roster.reason))

    def nearest(self, tick: int) -> int:
        """Return the newest recorded tick up to `tick`, or the first one.

        At least one must be recorded.
        """
        if tick in self.plant_states:
            return tick
        earlier = [recorded for recorded in self.plant_states if recorded < tick]
        return max(earlier, default=self.first)

    def roster(self, tick: int) -> Roster | None:
        """Return the roster at a tick; None while none is known."""
        until_then = [roster for roster in self._rosters if roster.tick <= tick]
        return max(until_then, key=lambda roster: roster.version, default=None)


def merged(events: Iterable[tuple[int, str]]) -> list[tuple[int, str]]:
    """Return events in the order of time, with one for all links that one request changes."""
    in_time = sorted(events, key=lambda event: event[0])
    together: list[tuple[int, str]] = []
    for (tick, are_single, settings), group in groupby(in_time, key=_request_of):
        texts = [text for _, text in group]
        links = {text.removesuffix(settings) for text in texts}
        if settings and links >= _ALL_LINKS:
            texts = [f"all links{settings}"]
        elif are_single and len(texts) > 1:
            texts = [f"{len(texts)} links{settings}"]
        together += [(tick, text) for text in texts]
    return together


def _request_of(event: tuple[int, str]) -> tuple[int, bool, str]:
    """Return tick, whether single links change, and their new settings; "" for other events."""
    tick, text = event
    change = _CHANGE.fullmatch(text)
    if change is None:
        return tick, False, ""
    links, settings = change.groups()
    return tick, _ONE_LINK.fullmatch(links) is not None, settings
