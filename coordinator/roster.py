"""The roster of a run, its links and its targets.

Their changes, and the messages that announce them.
"""

import json
from collections import deque
from collections.abc import Collection, Mapping
from typing import Any

from transport.protocol.scenario.errors import RequestError
from transport.protocol.scenario.faults import failures
from transport.protocol.scenario.links import link_change, words_of
from transport.protocol.scenario.schema import TargetSection
from transport.protocol.scenario.setup import Setup
from transport.protocol.scenario.targets import MOST, planned, scripted, target_in_words
from transport.protocol.wire.messages import (
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
    """The agents that take part in a run, and what has changed in it so far, repeated for agents that join.

    A change is announced with a roster, whose version ticks name: no process opens the next one
        without knowing it.
    """

    def __init__(self, setup: Setup, out: Outbox) -> None:
        self.agents = {agent_name(agent): agent for agent in setup.agents}  # all of the run
        self.members = set(setup.agents)  # on the roster
        self.joining: dict[
            int, int
        ] = {}  # to be put on it when the next tick opens, with their incarnations
        self.incarnations: dict[str, int] = {}  # newest ones of the processes that take part
        self.version = 0  # of the newest roster
        self._out, self._setup = out, setup
        self._links: list[LinkChange] = []
        self._targets: list[Target] = []
        self._scripted = deque(scripted(setup))  # targets still to be announced
        self._uav_faults = deque(failures(setup.faults))  # still to be reported
        self._off: set[int] = set()  # UAVs without motors, 1-based
        self._released: set[int] = set()
        self._returns: dict[int, set[int]] = {}  # agents that scripted faults bring back, by tick
        for fault in setup.faults if setup.scenario.clock.mode == "lockstep" else ():
            if fault.do in ("continue", "start") and fault.target in self.agents:
                self._returns.setdefault(fault.tick, set()).add(self.agents[fault.target])

    def time(self, tick: int) -> str:
        """Return the time of a tick as text."""
        return f"t = {tick * self._setup.period_ns / 1e9:.2f} s"

    def message(self, reason: str, tick: int) -> Roster:
        """Return the next version of the roster, which holds from a tick on."""
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

    def awaited(self, tick: int) -> set[int]:
        """Return the agents a tick waits for.

        Scripted faults bring them back at it, and they are not ready yet.
        """
        return self._returns.get(tick, set()) - self.joining.keys() - self.members

    def give_up(self, tick: int) -> Roster:
        """Return the roster without the agents that a tick has waited for."""
        return self.message(
            f"{names(self._returns.pop(tick))} did not return at {self.time(tick)}", tick - 1
        )

    def begin(self, tick: int) -> tuple[set[int], list[Message]]:
        """Return the agents that join at a tick that opens, and the messages of all that changes at it."""
        joined, self.joining = self.joining, {}
        messages: list[Message] = []
        if joined:
            messages += [self._out.again(message) for message in [*self._links, *self._targets]]
            self.members |= joined.keys()
            self.incarnations |= {
                agent_name(agent): incarnation for agent, incarnation in joined.items()
            }
            messages.append(self.message(f"{names(joined)} joined at {self.time(tick)}", tick))
        while self._uav_faults and self._uav_faults[0].tick <= tick:
            fault = self._uav_faults.popleft()
            self._off.add(fault.uav + 1)
            if fault.do == "release":
                self._released.add(fault.uav + 1)
            event = "released" if fault.do == "release" else "motors off"
            messages.append(self.message(f"{fault.target} {event} at {self.time(tick)}", tick))
        while self._scripted and self._scripted[0][0] <= tick:
            try:
                messages += self.target(self._scripted.popleft()[1], tick)
            except RequestError as error:
                messages.append(self.message(f"target refused: {error}", tick - 1))
        return set(joined), messages

    def link(self, given: Mapping[str, Any], tick: int) -> list[LinkChange | Roster]:
        """Return the messages of a change of links that holds from a tick on.

        The request has a sender "from", a receiver "to", each omitted for any agent, and the
        "settings" to change.

        Raises: RequestError: the request is refused.
        """
        source, target = (str(given.get(end, "")) for end in ("from", "to"))
        known = [PLANT, *self.agents]
        for end, name in (("from", source), ("to", target)):
            if name and name not in known:
                raise RequestError(f"{end}: expected one of {', '.join(known)}, got {name!r}")
        settings = json.dumps(given.get("settings"))
        if not link_change(source, target, settings).settings():
            raise RequestError("expected at least one key of a link, got none")
        if len(settings) > MAX_TEXT:
            raise RequestError(
                f"settings: expected at most {MAX_TEXT} characters, got {len(settings)}"
            )
        number = len(self._links) + 1
        change = self._out.stamp(
            LinkChange, tick=tick, number=number, source=source, target=target, settings=settings
        )
        self._links.append(change)
        return [change, self.message(f"{words_of(change)}, from {self.time(tick)} on", tick - 1)]

    def target(self, section: TargetSection, tick: int) -> list[Target | Roster]:
        """Return the messages of a target that holds from a tick on.

        Raises: RequestError: it cannot be flown.
        """
        if len(self._targets) == MOST:
            raise RequestError(f"expected at most {MOST} targets in a run")
        target = self._out.stamp(
            Target, number=len(self._targets) + 1, **planned(self._setup, section, tick)
        )
        self._setup = self._setup.after([target])
        self._targets.append(target)
        return [target, self.message(f"{target_in_words(target)}, from {self.time(tick)} on", tick)]


def names(agents: Collection[int]) -> str:
    """Return the process names of agents as text."""
    return ", ".join(agent_name(agent) for agent in sorted(agents))
