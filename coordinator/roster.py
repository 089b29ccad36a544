"""The roster of a run, its links and its targets: their changes, and the messages about them."""

import json
from collections import deque
from collections.abc import Collection, Mapping
from itertools import permutations
from typing import Any

from transport.protocol.scenario.errors import RequestError
from transport.protocol.scenario.faults import failures
from transport.protocol.scenario.link_changes import changed_in_words, link_change, words_of
from transport.protocol.scenario.maneuver_sections import TargetSection
from transport.protocol.scenario.setup import Setup
from transport.protocol.scenario.target_planning import target_fields
from transport.protocol.scenario.targets import scripted, target_in_words
from transport.protocol.wire.messages import (
    MAX_TARGETS,
    MAX_TEXT,
    LinkChange,
    Message,
    Roster,
    Target,
    agent_name,
)
from transport.protocol.wire.names import PLANT
from transport.protocol.wire.node import Outbox


class TeamRoster:
    """The agents that take part in a run, and all changes so far, repeated for agents that join.

    A change is announced with a roster, whose version ticks name: no process opens the next tick
    without that version.

    Attributes:
        agents: All agents of the run, by process name.
        members: The agents on the roster.
        joining: Incarnations of the agents that are put on it when the next tick opens.
        incarnations: Newest ones of the processes that take part, by name.
        version: Version of the newest roster.
    """

    def __init__(self, setup: Setup, out: Outbox) -> None:
        self._setup = setup
        self._out = out
        self.agents = {agent_name(agent): agent for agent in setup.agents}
        self.members = set(setup.agents)
        self.joining: dict[int, int] = {}
        self.incarnations: dict[str, int] = {}
        self.version = 0

        self._links: list[LinkChange] = []
        self._targets: list[Target] = []
        self._scripted = deque(scripted(setup))  # targets still to be announced
        self._uav_faults = deque(failures(setup.faults))  # still to be reported
        self._off: set[int] = set()  # UAVs without motors, 1-based
        self._released: set[int] = set()  # UAVs off their rods, 1-based
        self._returns = self._scripted_returns()  # agents that scripted faults bring back, by tick

    def _scripted_returns(self) -> dict[int, set[int]]:
        """Return the agents that the script brings back, by tick; in real time no tick waits."""
        returns: dict[int, set[int]] = {}
        if self._setup.scenario.clock.mode != "lockstep":
            return returns
        for fault in self._setup.faults:
            if fault.do in ("continue", "start") and fault.target in self.agents:
                returns.setdefault(fault.tick, set()).add(self.agents[fault.target])
        return returns

    def time(self, tick: int) -> str:
        """Return the time of a tick as text."""
        return f"t = {tick * self._setup.period_ns / 1e9:.2f} s"

    def message(self, reason: str, tick: int) -> Roster:
        """Return the next version of the roster, which holds from a tick on.

        A tick that opens takes the roster's changes along; see `report` for news between ticks.
        """
        members = sorted(self.members)
        self.version += 1
        return self._out.stamp(
            Roster,
            tick=max(tick, 0),
            version=self.version,
            agents=tuple(members),
            incarnations=tuple(self.incarnations[agent_name(agent)] for agent in members),
            off=tuple(sorted(self._off)),
            released=tuple(sorted(self._released)),
            reason=reason,
        )

    def report(self, reason: str, upcoming: int) -> Roster:
        """Return a roster whose members are as before, and which only tells the reason.

        It belongs to the tick that is still open, the one before the upcoming tick.
        """
        return self.message(reason, upcoming - 1)

    def due_back(self, tick: int) -> set[int]:
        """Return the agents that the script brings back at a tick, and that are not ready yet."""
        return self._returns.get(tick, set()) - self.joining.keys() - self.members

    def give_up(self, tick: int) -> Roster:
        """Return the roster without the agents that a tick has waited for."""
        absent = names(self.due_back(tick))
        del self._returns[tick]
        return self.report(f"{absent} did not return at {self.time(tick)}", tick)

    def begin(self, tick: int) -> tuple[set[int], list[Message]]:
        """Return the agents that join at a tick that opens, and the messages of all its changes."""
        joined = set(self.joining)
        messages: list[Message] = []
        if joined:
            messages += self._join(tick)
        messages += self._report_failures(tick)
        messages += self._announce_targets(tick)
        return joined, messages

    def repeated(self) -> list[Message]:
        """Return all changes of links and targets so far, for a process that joins."""
        return [self._out.again(message) for message in [*self._links, *self._targets]]

    def _join(self, tick: int) -> list[Message]:
        """Put the joining agents on the roster; return all changes so far, and the roster."""
        repeated = self.repeated()
        self.members |= self.joining.keys()
        for agent, incarnation in self.joining.items():
            self.incarnations[agent_name(agent)] = incarnation

        reason = f"{names(self.joining)} joined at {self.time(tick)}"
        self.joining = {}
        return [*repeated, self.message(reason, tick)]

    def _report_failures(self, tick: int) -> list[Message]:
        """Return a roster for each failure of a UAV that is due at a tick."""
        messages: list[Message] = []
        while self._uav_faults and self._uav_faults[0].tick <= tick:
            fault = self._uav_faults.popleft()
            event = "motors off"
            self._off.add(fault.uav + 1)
            if fault.do == "release":
                event = "released"
                self._released.add(fault.uav + 1)
            messages.append(self.message(f"{fault.target} {event} at {self.time(tick)}", tick))
        return messages

    def _announce_targets(self, tick: int) -> list[Message]:
        """Return the messages of the scripted targets that are due at a tick."""
        messages: list[Message] = []
        while self._scripted and self._scripted[0][0] <= tick:
            _, section = self._scripted.popleft()
            try:
                messages += self.target(section, tick)
            except RequestError as error:
                messages.append(self.report(f"target refused: {error}", tick))
        return messages

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
        ends, words = self._changed(given)
        for source, target in ends:
            link_change(source, target, settings)  # refused here: agents take only valid changes
        for source, target in ends:
            change = self._out.stamp(
                LinkChange,
                tick=tick,
                number=len(self._links) + 1,
                source=source,
                target=target,
                settings=settings,
            )
            self._links.append(change)
            changes.append(change)
        reason = changed_in_words(words, given["settings"]) if words else words_of(changes[0])
        return [*changes, self.report(f"{reason}, from {self.time(tick)} on"[:MAX_TEXT], tick)]

    def _changed(self, given: Mapping[str, Any]) -> tuple[list[tuple[str, str]], str]:
        """Return sender and receiver of each link in a request, empty for any agent, and words.

        The words are empty for one sender and receiver.
        """
        several = [name for name in ("groups", "all") if name in given]
        if several and len(given.keys() & {"from", "to", "groups", "all"}) > 1:
            raise RequestError(f"{several[0]}: expected no other links beside it")
        if "all" in given:
            return [("", ""), (PLANT, ""), ("", PLANT)], "all links"
        if "groups" not in given:
            return [self._ends(given)], ""

        groups = self._groups(given["groups"])
        ends = [
            (sender, receiver)
            for group, other in permutations(groups, 2)
            for sender in group
            for receiver in other
        ]
        return ends, f"links between {' | '.join(', '.join(group) for group in groups)}"

    def _ends(self, given: Mapping[str, Any]) -> tuple[str, str]:
        """Return sender and receiver in a request of a link, empty for any agent."""
        source = str(given.get("from", ""))
        target = str(given.get("to", ""))
        names = [PLANT, *self.agents]
        for end, name in (("from", source), ("to", target)):
            if name and name not in names:
                raise RequestError(f"{end}: expected one of {', '.join(names)}, got {name!r}")
        return source, target

    def _groups(self, given: Any) -> list[list[str]]:
        """Return the groups of agents in a request, each agent at most once."""
        is_list = isinstance(given, list) and all(isinstance(group, list) for group in given)
        names = [str(name) for group in given for name in group] if is_list else []
        is_valid = len(names) == len(set(names)) and set(names) <= self.agents.keys()
        if not is_list or len(given) < 2 or not all(given) or not is_valid:
            raise RequestError(
                f"groups: expected two or more lists of agents, each once, got {given!s:.60}"
            )
        return [[str(name) for name in group] for group in given]

    def target(self, section: TargetSection, tick: int) -> list[Target | Roster]:
        """Return the messages of a target that holds from a tick on.

        Raises: RequestError: it cannot be flown.
        """
        if len(self._targets) == MAX_TARGETS:
            raise RequestError(f"expected at most {MAX_TARGETS} targets in a run")
        number = len(self._targets) + 1
        target = self._out.stamp(Target, number=number, **target_fields(self._setup, section, tick))
        self._setup = self._setup.after([target])
        self._targets.append(target)
        words = f"{target_in_words(target)}, from {self.time(tick)} on"
        return [target, self.message(words, tick)]


def names(agents: Collection[int]) -> str:
    """Return the process names of agents as text."""
    return ", ".join(agent_name(agent) for agent in sorted(agents))
