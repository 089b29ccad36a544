"""The way down of a team of vehicles, which stay on their rods until a person says that they are off.

    in flight    --`transport land`, `transport abort`, a low battery--> coming down, by the team's law
    coming down  --the reference is at rest--> down: the team goes on controlling all UAVs
    down         --`transport release`, or the last tick--> the run ends: each autopilot has its UAV

No UAV is left to its own autopilot before: on a rod it would pull the others along.
"""

from collections.abc import Sequence

from transport.coordinator.link_and_target_changes import Changes
from transport.coordinator.roster import TeamRoster
from transport.protocol.admission.told_changes import rests_at
from transport.protocol.scenario.sections.scenario_errors import RequestError
from transport.protocol.wire.messages import Message, VehicleStatus

# Speeds of an abort that are tried, m/s; the last one is that of `transport land`.
_SPEEDS_MPS = (2.0, 1.0, 0.5)


class ComingDown:
    """What the coordinator knows of the way down.

    battery: Share of a battery below which the team comes down by itself.

    Attributes:
        aborted: Why the run has no end in order; empty without an abort.
    """

    def __init__(
        self, changes: Changes, roster: TeamRoster, battery: float, period_s: float
    ) -> None:
        self._changes = changes
        self._roster = roster
        self._battery = battery
        self._period_s = period_s
        self._is_warned = False
        self.aborted = ""

    def down_at(self) -> int | None:
        """Return the tick from which on the team is down; None while it does not come down."""
        landing = self._changes.landing
        return None if landing is None else rests_at(landing, self._period_s)

    def abort(self, tick: int) -> Sequence[Message]:
        """Return the messages of the fastest landing that the team can fly, from a tick on.

        Raises: RequestError: there is none before the end of the run.
        """
        for speed_mps in _SPEEDS_MPS:
            try:
                messages = self._changes.target({"land": True, "speed_mps": speed_mps}, tick)
            except RequestError as error:
                refusal = error
                continue
            self.aborted = f"aborted by a person at {self._roster.time(tick)}"
            return messages
        raise refusal

    def watch(self, status: VehicleStatus, tick: int) -> Sequence[Message]:
        """Return the messages of a landing from a tick on where the battery of a UAV is low, once."""
        is_low = 0.0 <= status.battery < self._battery
        if not is_low or self._is_warned or self._changes.landing is not None:
            return ()
        self._is_warned = True
        reason = f"battery of UAV{status.uav} at {status.battery:.0%}"
        try:
            landing: Sequence[Message] = self._changes.target({"land": True}, tick)
        except RequestError as error:
            return [self._roster.report(f"{reason}; landing refused: {error}", tick)]
        return [*landing, self._roster.report(f"{reason}: the team lands", tick)]

    def check_release(self, tick: int) -> None:
        """Raise RequestError unless the team is down at a tick."""
        down_at = self.down_at()
        if down_at is None:
            raise RequestError(
                "expected a team that has landed (`transport land`), got one in flight"
            )
        if tick < down_at:
            expected = f"expected a team at rest, from {self._roster.time(down_at)} on"
            raise RequestError(f"{expected}, got {self._roster.time(tick)}")
