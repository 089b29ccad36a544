"""Targets of a run: those of its scenario and those that are requested during it."""

from collections import deque
from collections.abc import Mapping
from typing import Any

from protocol.scenario.schema import TargetSection
from protocol.scenario.setup import Setup
from protocol.scenario.targets import MOST, TargetError, asked, headed, planned, scripted
from protocol.wire.messages import Target
from protocol.wire.node import Outbox


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
