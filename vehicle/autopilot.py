"""Interface of an autopilot, as the process of its UAV uses it.

    state    what it measures, and whether it may be believed
    command  thrust and body rates, as a setpoint that it forgets by itself soon
    arm      arm it, and let it take setpoints
    hold     let it hold its place by itself
    land     let it land by itself

A driver turns these into the messages of one autopilot; how thrust becomes throttle, which modes
there are, and what happens when setpoints stop is known there alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from transport.model.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotState:
    """What an autopilot has told.

    Attributes:
        sensed: Position, velocity, attitude, body rates, specific force, (15,), SI, in the common
            frame north, east, down and about forward, right, down; None before all are known.
        position_ns: Time of arrival of position and velocity, ns of a steady clock.
        attitude_ns: The same of attitude and body rates.
        position_s: Time of position and velocity by the autopilot's own clock.
        armed: Whether the motors run.
        takes_setpoints: Whether it is in the mode in which it obeys `command`.
        is_healthy: Whether its estimate of position and velocity is valid.
        battery: Share of the battery that is left; -1 where it is not known.
        thrust_N: Thrust that it commands at the moment; None where it is not known.
        mode: Name of its mode, for people.
        says: The last text that it sent, for people.
    """

    sensed: Array | None
    position_ns: int
    attitude_ns: int
    position_s: float
    armed: bool
    takes_setpoints: bool
    is_healthy: bool
    battery: float
    thrust_N: float | None
    mode: str
    says: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One check before the autopilot is let go.

    Attributes:
        subject: Parameter or property.
        expected: Value that is needed, for people.
        got: Value that it has; empty while it is not known.
        is_met: Whether it fits.
        reason: Why it is needed.
    """

    subject: str
    expected: str
    got: str
    is_met: bool
    reason: str

    def __str__(self) -> str:
        got = self.got or "no answer yet"
        return f"{self.subject}: expected {self.expected}, got {got} ({self.reason})"


class Autopilot(Protocol):
    """One autopilot. Times are ns of a steady clock."""

    @property
    def tells_thrust(self) -> bool:
        """Whether its states have its thrust, some time after its first sign of life."""

    def state(self) -> AutopilotState | None:
        """Return what it has told; None before its first sign of life, and after 2 s without."""

    def silence(self) -> str:
        """Return in words that it has not been heard, and what has been heard in its place."""

    def attend(self, now_ns: int) -> None:
        """Send what is due besides setpoints; to be called at least ten times a second."""

    def findings(self) -> Sequence[Finding]:
        """Return the checks, met or not."""

    def command(self, thrust_N: float, rates_rads: Array, since_s: float) -> None:
        """Send a setpoint: thrust and body rates, (3,), by knowledge of an instant of the run, s."""

    def arm(self) -> None:
        """Ask it to take setpoints and to arm; refusals appear in the state."""

    def hold(self) -> None:
        """Ask it to hold its place by itself."""

    def land(self) -> None:
        """Ask it to land by itself."""

    def close(self) -> None:
        """Close the link."""
