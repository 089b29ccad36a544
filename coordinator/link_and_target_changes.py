"""Changes of links and targets during a run: those announced so far, and the messages of new ones."""

import json
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import permutations
from typing import Any

from transport.coordinator.roster import TeamRoster
from transport.coordinator.team_view import TargetPlanner
from transport.protocol.admission.told_changes import ToldChanges, changes_in
from transport.protocol.scenario.links.link_changes import changed_in_words, link_change, words_of
from transport.protocol.scenario.sections.scenario_errors import RequestError
from transport.protocol.wire.message_form import MAX_TARGETS, MAX_TEXT
from transport.protocol.wire.messages import LinkChange, Message, Roster, Target, VehicleStatus
from transport.protocol.wire.names import PLANT
from transport.protocol.wire.outbox import Outbox


class Changes:
    """Changes of links and targets, numbered from 1, each told with a roster that names its tick.

    Processes that join are told all of them again, in order: they take a change only after those of
    smaller numbers.

    Attributes:
        told: Those so far; a coordinator that returns to a team of vehicles learns earlier ones from them.
    """

    def __init__(
        self,
        roster: TeamRoster,
        out: Outbox,
        planner: TargetPlanner,
        scripted: Iterable[tuple[int, Any]],
        lands_at: int | None = None,
    ) -> None:
        self._roster = roster
        self._planner = planner
        self._out = out
        self.told = ToldChanges()
        self._scripted = deque(scripted)  # targets still to be announced
        self._lands_at = lands_at  # `TeamView.lands_at`, until the landing is told

    def repeated(self) -> list[Message]:
        """Return all changes so far, for a process that joins."""
        return [self._out.again(message) for message in [*self.told.links, *self.told.targets]]

    def learn(self, status: VehicleStatus) -> None:
        """Take over what an earlier coordinator has told, from a vehicle that knows it."""
        for change in changes_in(status):
            if not self.told.add(change) or not isinstance(change, Target):
                continue
            self._planner.follow(change)
            is_scripted = any(tick == change.tick for tick, _ in self._scripted)
            # The script was followed until then.
            while self._scripted and self._scripted[0][0] <= change.tick:
                self._scripted.popleft()
            if change.lands and not is_scripted:
                self._scripted.clear()

    @property
    def landing(self) -> Target | None:
        """The newest target, if the team comes down by it."""
        newest = self.told.targets[-1] if self.told.targets else None
        return newest if newest is not None and newest.lands else None

    def announce_scripted(self, tick: int) -> list[Message]:
        """Return the messages of the scripted targets that are due at a tick."""
        messages: list[Message] = []
        while self._scripted and self._scripted[0][0] <= tick:
            _, wanted = self._scripted.popleft()
            messages += self._scripted_target(wanted, tick)
        if self._lands_at is not None and tick >= self._lands_at:
            self._lands_at = None
            if self.landing is None:
                messages += self._scripted_target({"land": True}, tick)
        return messages

    def _scripted_target(self, wanted: Any, tick: int) -> Sequence[Message]:
        """Return the messages of a target without a request that awaits an answer."""
        try:
            return self._target(wanted, tick)
        except RequestError as error:
            return [self._roster.report(f"target refused: {error}", tick)]

    def target(self, wanted: Any, tick: int) -> Sequence[Target | Roster]:
        """Return the messages of a target that was not scripted, which holds from a tick on.

        No scripted target follows a landing: it would lead the team up again.

        Raises: RequestError: the team cannot reach it.
        """
        messages = self._target(wanted, tick)
        if self.landing is not None:
            self._scripted.clear()
        return messages

    def _target(self, wanted: Any, tick: int) -> list[Target | Roster]:
        """Return the messages of a target. Raises: RequestError."""
        if len(self.told.targets) == MAX_TARGETS:
            raise RequestError(f"expected at most {MAX_TARGETS} targets in a run")
        number = len(self.told.targets) + 1
        target = self._out.stamp(Target, number=number, **self._planner.fields(wanted, tick))
        self._planner.follow(target)
        self.told.add(target)
        words = f"{target.in_words()}, from {self._roster.time(tick)} on"
        return [target, self._roster.message(words, tick)]

    def link(self, given: Mapping[str, Any], tick: int) -> list[LinkChange | Roster]:
        """Return the messages of a change of links that holds from a tick on.

        The request has the "settings" to change, and the links that change: a sender "from" and a
        receiver "to", each omitted for any agent; or "groups" of agents, lists of names, for all
        links from one group to another; or "all", for those of the plant as well.

        Raises: RequestError: the request is refused.
        """
        settings = json.dumps(given.get("settings"))
        if not link_change("", "", settings).settings():
            raise RequestError("expected at least one key of a link, got none")
        if len(settings) > MAX_TEXT:
            raise RequestError(
                f"settings: expected at most {MAX_TEXT} characters, got {len(settings)}"
            )

        changes = []
        ends, words = _changed_links(given, self._roster.agents)
        for source, target in ends:
            link_change(source, target, settings)  # refused here: agents take only valid changes
        for source, target in ends:
            change = self._out.stamp(
                LinkChange,
                tick=tick,
                number=len(self.told.links) + 1,
                source=source,
                target=target,
                settings=settings,
            )
            self.told.add(change)
            changes.append(change)
        reason = changed_in_words(words, given["settings"]) if words else words_of(changes[0])
        text = f"{reason}, from {self._roster.time(tick)} on"[:MAX_TEXT]
        return [*changes, self._roster.report(text, tick)]


def _changed_links(
    given: Mapping[str, Any], agents: Collection[str]
) -> tuple[list[tuple[str, str]], str]:
    """Return sender and receiver of each link in a request, empty for any agent, and words.

    The words are empty for one sender and receiver. Raises: RequestError.
    """
    several = [name for name in ("groups", "all") if name in given]
    if several and len(given.keys() & {"from", "to", "groups", "all"}) > 1:
        raise RequestError(f"{several[0]}: expected no other links beside it")
    if "all" in given:
        return [("", ""), (PLANT, ""), ("", PLANT)], "all links"
    if "groups" not in given:
        return [_ends(given, agents)], ""

    groups = _groups(given["groups"], agents)
    ends = [
        (sender, receiver)
        for group, other in permutations(groups, 2)
        for sender in group
        for receiver in other
    ]
    return ends, f"links between {' | '.join(', '.join(group) for group in groups)}"


def _ends(given: Mapping[str, Any], agents: Collection[str]) -> tuple[str, str]:
    """Return sender and receiver in a request of a link, empty for any agent."""
    source = str(given.get("from", ""))
    target = str(given.get("to", ""))
    expected = [PLANT, *agents]
    for end, name in (("from", source), ("to", target)):
        if name and name not in expected:
            raise RequestError(f"{end}: expected one of {', '.join(expected)}, got {name!r}")
    return source, target


def _groups(given: Any, agents: Collection[str]) -> list[list[str]]:
    """Return the groups of agents in a request, each agent at most once."""
    is_list = isinstance(given, list) and all(isinstance(group, list) for group in given)
    named = [str(name) for group in given for name in group] if is_list else []
    is_valid = len(named) == len(set(named)) and set(named) <= set(agents)
    if not is_list or len(given) < 2 or not all(given) or not is_valid:
        raise RequestError(
            f"groups: expected two or more lists of agents, each once, got {given!s:.60}"
        )
    return [[str(name) for name in group] for group in given]
