"""Changes of links that are requested during a run."""

import json
from collections.abc import Mapping
from typing import Any

from protocol.scenario.links import LinkError, link_change
from protocol.scenario.setup import Setup
from protocol.wire.messages import LinkChange, agent_name
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
