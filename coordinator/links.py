"""Requests during a run that change links or the target: numbered, announced with the next tick."""

import json
from collections import deque
from collections.abc import Mapping
from typing import Any

from protocol.scenario.errors import RequestError, requested
from protocol.scenario.links import link_change
from protocol.scenario.schema import TargetSection
from protocol.scenario.setup import Setup
from protocol.scenario.targets import MOST, headed, planned, scripted
from protocol.wire.messages import LinkChange, Message, Target, agent_name
from protocol.wire.names import PLANT
from protocol.wire.node import Outbox


class Changes:
    """The link changes and targets of a run so far: checked, numbered, and repeated for agents that join."""

    def __init__(self, setup: Setup, out: Outbox) -> None:
        self._setup, self._out = setup, out
        self._names = [PLANT, *map(agent_name, setup.agents)]
        self._scripted = deque(scripted(setup))
        self._links: list[LinkChange] = []
        self._targets: list[Target] = []

    def link(self, given: Mapping[str, Any], tick: int) -> LinkChange:
        """Return the message of a change of links that holds from a tick on.

        The request has a sender "from", a receiver "to", each omitted for any agent, and the "settings" to change.

        Raises: RequestError: the request is refused.
        """
        source, target = (str(given.get(end, "")) for end in ("from", "to"))
        for end, name in (("from", source), ("to", target)):
            if name and name not in self._names:
                raise RequestError(f"{end}: expected one of {', '.join(self._names)}, got {name!r}")
        settings = json.dumps(given.get("settings"))
        if not link_change(source, target, settings).settings():
            raise RequestError("expected at least one key of a link, got none")
        number = len(self._links) + 1
        message = self._out.stamp(LinkChange, tick=tick, number=number, source=source, target=target, settings=settings)
        self._links.append(message)
        return message

    def target(self, given: TargetSection | Mapping[str, Any], tick: int) -> Target:
        """Return the message of a target that holds from a tick on; `given` are the keys of `maneuver.target`.

        Raises: RequestError: it cannot be flown.
        """
        section = given if isinstance(given, TargetSection) else requested(TargetSection, dict(given))
        if len(self._targets) == MOST:
            raise RequestError(f"expected at most {MOST} targets in a run")
        message = self._out.stamp(Target, number=len(self._targets) + 1, **planned(self._setup, section, tick))
        self._setup = headed(self._setup, message)
        self._targets.append(message)
        return message

    def due(self, tick: int) -> list[Target | RequestError]:
        """Return the targets of the scenario at a tick, or why they cannot be flown any more."""
        found: list[Target | RequestError] = []
        while self._scripted and self._scripted[0][0] <= tick:
            try:
                found.append(self.target(self._scripted.popleft()[1], tick))
            except RequestError as error:
                found.append(error)
        return found

    def repeated(self) -> list[Message]:
        """Return all changes so far, stamped anew, for agents that join."""
        return [self._out.again(message) for message in [*self._links, *self._targets]]
