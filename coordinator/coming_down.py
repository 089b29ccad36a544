"""The way down of a team of vehicles, which stay on their rods until a person says that they are off.

    in flight    --`transport land`, `transport abort`, a signal to the coordinator, a low battery,
                   outside the end of the maneuver--> coming down, by the team's law
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
    lands_at: Outside, tick of the end of the maneuver, after which it has come down, or is low already.

    Attributes:
        aborted: Why the run has no end in order; empty without an abort.
    """

    def __init__(
        self,
        changes: Changes,
        roster: TeamRoster,
        battery: float,
        period_s: float,
        lands_at: int | None = None,
    ) -> None:
        self._changes = changes
        self._roster = roster
        self._battery = battery
        self._period_s = period_s
        self._lands_at = lands_at
        self._modes: dict[int, tuple[bool, str]] = {}  # by UAV: armed, and mode, at its first word
        self._newest_modes: dict[int, tuple[bool, str]] = {}
        self._is_warned = False
        self._is_interrupted = False
        self.aborted = ""

    def down_at(self) -> int | None:
        """Return the tick from which on the team is down; None while it does not come down."""
        landing = self._changes.landing
        if landing is not None:
            return rests_at(landing, self._period_s)
        return self._lands_at  # a maneuver that ends on the ground is followed by no landing

    def abort(self, tick: int, whose: str = "a person") -> Sequence[Message]:
        """Return the messages of the fastest landing that the team can fly, from a tick on.

        Raises: RequestError: there is none before the end of the run, which only a simulated one has.
        """
        for speed_mps in _SPEEDS_MPS:
            try:
                messages = self._changes.target({"land": True, "speed_mps": speed_mps}, tick)
            except RequestError as error:
                refusal = error
                continue
            self.aborted = f"aborted by {whose} at {self._roster.time(tick)}"
            return messages
        raise refusal

    def interrupt(self, reason: str, tick: int) -> Sequence[Message]:
        """Return the messages by which a team in the air comes down because of a signal.

        None at the second signal: the run ends at once, as it does above a simulated team.
        """
        if self._lands_at is None or self._is_interrupted:
            return ()
        self._is_interrupted = True
        try:
            landing = self.abort(tick, f"a signal ({reason})")
        except RequestError:  # it is down
            landing = ()
        self.aborted = self.aborted or f"{reason} at {self._roster.time(tick)}"
        told = (
            f"{reason}: the team lands, and waits for `transport release`; once more ends the run"
        )
        return [*landing, self._roster.report(told, tick)]

    def watch(self, status: VehicleStatus, tick: int) -> Sequence[Message]:
        """Return the messages of a landing from a tick on where the battery of a UAV is low, once.

        And a note where a UAV is no longer armed in the mode in which it began, or is so again.
        """
        return [*self._mode_changed(status, tick), *self._landed_by_battery(status, tick)]

    def _mode_changed(self, status: VehicleStatus, tick: int) -> Sequence[Message]:
        if not status.mode or status.phase != "flying":  # its autopilot is silent, or has it
            return ()
        mode = status.armed, status.mode
        first = self._modes.setdefault(status.uav, mode)
        before = self._newest_modes.get(status.uav, first)
        self._newest_modes[status.uav] = mode
        if mode == before:
            return ()
        if mode == first:
            text = f"back in mode {status.mode}"
        elif not status.armed:
            text = "disarmed in flight"
        else:
            text = f"mode {status.mode}, not {first[1]}: its setpoints have no effect"
        return [self._roster.report(f"UAV{status.uav}: {text}", tick)]

    def _landed_by_battery(self, status: VehicleStatus, tick: int) -> Sequence[Message]:
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
        if down_at is None or (self._changes.landing is None and tick < down_at):
            raise RequestError(
                "expected a team that has landed (`transport land`), got one in flight"
            )
        if tick < down_at:
            expected = f"expected a team at rest, from {self._roster.time(down_at)} on"
            raise RequestError(f"{expected}, got {self._roster.time(tick)}")
