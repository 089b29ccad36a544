"""Requests during a run that change links or the target: numbered, announced with the next tick."""

import json
from collections import deque
from collections.abc import Mapping
from typing import Any

from protocol.scenario.links import LinkError, link_change
from protocol.scenario.schema import TargetSection
from protocol.scenario.setup import Setup
from protocol.scenario.targets import MOST, TargetError, asked, headed, planned, scripted
from protocol.wire.messages import LinkChange, Target, agent_name
from protocol.wire.names import PLANT
from protocol.wire.node import Outbox


class RequestedLinkChanges:
    """The link changes of a run so far: checked, numbered, and repeated for agents that join."""

    def __init__(self, setup: Setup, out: Outbox) -> None:
        self._out, self._samples = out, setup.samples_s
        self._names = [PLANT, *map(agent_name, setup.agents)]
        self._changes: list[LinkChange] = []

    def change(self, given: Mapping[str, Any], tick: int) -> LinkChange:
        """Return the message of a change that holds from a tick on.

        The request has a sender "from", a receiver "to", each omitted for any agent, and the "settings" to change.

        Raises: LinkError: the request is refused.
        """
        source, target = (str(given.get(end, "")) for end in ("from", "to"))
        for end, name in (("from", source), ("to", target)):
            if name and name not in self._names:
                raise LinkError(f"{end}: expected one of {', '.join(self._names)}, got {name!r}")
        settings = json.dumps(given.get("settings"))
        change = link_change(source, target, settings, self._samples)
        if not change.settings():
            raise LinkError("expected at least one key of a link, got none")
        number = len(self._changes) + 1
        message = self._out.stamp(LinkChange, tick=tick, number=number, source=source, target=target, settings=settings)
        self._changes.append(message)
        return message

    def repeated(self) -> list[LinkChange]:
        """Return all changes so far, stamped anew, for agents that join."""
        return [self._out.again(change) for change in self._changes]


class Targets:
    """The targets so far: checked, timed, numbered, and repeated for agents that join."""

    def __init__(self, setup: Setup, out: Outbox) -> None:
        self._setup, self._out = setup, out
        self._scripted = deque(scripted(setup))
        self._known: list[Target] = []

    def request(self, given: Mapping[str, Any], tick: int) -> Target:
        """Return the message of a target that holds from a tick on; `given` are the keys of `maneuver.target`.

        Raises: TargetError: it cannot be flown.
        """
        return self._announced(asked(given), tick)

    def due(self, tick: int) -> list[Target | TargetError]:
        """Return the targets of the scenario at a tick, or why they cannot be flown any more."""
        found: list[Target | TargetError] = []
        while self._scripted and self._scripted[0][0] <= tick:
            try:
                found.append(self._announced(self._scripted.popleft()[1], tick))
            except TargetError as error:
                found.append(error)
        return found

    def repeated(self) -> list[Target]:
        """Return all targets so far, stamped anew, for agents that join."""
        return [self._out.again(target) for target in self._known]

    def _announced(self, section: TargetSection, tick: int) -> Target:
        if len(self._known) == MOST:
            raise TargetError(f"expected at most {MOST} targets in a run")
        message = self._out.stamp(Target, number=len(self._known) + 1, **planned(self._setup, section, tick))
        self._setup = headed(self._setup, message)
        self._known.append(message)
        return message
