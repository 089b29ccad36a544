"""Checks of a UAV and its autopilot before tick 0: settings, estimate, battery, thrust.

Each returns in words what is wrong, or an empty text.
"""

from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.vehicle.autopilot import Autopilot, AutopilotState

# Weight of the newest thrust in the mean thrust of a hover: the mean is over about a second of turns.
_FRESH = 0.02
_CARRIES = 0.95  # share of the thrust of hover from which on the UAV may leave its stand
_NO_THRUST = "the autopilot does not tell its thrust (ATTITUDE_TARGET)"


class ChecksBeforeFlight:
    """What keeps one UAV from flying.

    Args:
        section: Limits.
        autopilot: Its autopilot.
        weight_N: Thrust of hover: the UAV and its part of the load.
        stands: Whether it stands until tick 0, or hovers by itself.
    """

    def __init__(
        self, section: VehiclesSection, autopilot: Autopilot, weight_N: float, *, stands: bool
    ) -> None:
        self._section = section
        self._autopilot = autopilot
        self._weight_N = weight_N
        self._stands = stands
        self._mean_N: float | None = None  # of the autopilot's own thrust in its hover

    def problem(self, told: AutopilotState | None) -> str:
        """Return why the UAV may not be armed, or may not leave the hover of its autopilot."""
        if told is None:
            return self._autopilot.silence()
        unmet = [str(finding) for finding in self._autopilot.findings() if not finding.is_met]
        if unmet:
            return "; ".join(unmet)
        if told.sensed is None or not told.is_healthy:
            return f"the autopilot has no valid estimate of its position: {told.says}".strip(": ")
        if 0.0 <= told.battery < self._section.battery:
            wanted = f"expected at least {self._section.battery:.0%}"
            return f"battery: {wanted}, got {told.battery:.0%}"
        return self._misloaded(told)

    def _misloaded(self, told: AutopilotState) -> str:
        """Return how the mean thrust of a hover by the autopilot differs from the weight that is carried."""
        is_hovering = told.armed and told.takes_setpoints and not self._stands
        if not is_hovering or not self._section.hover_share:
            return ""
        if told.thrust_N is None:
            return _NO_THRUST
        before_N = told.thrust_N if self._mean_N is None else self._mean_N
        self._mean_N = before_N + _FRESH * (told.thrust_N - before_N)

        if abs(self._mean_N - self._weight_N) <= self._section.hover_share * self._weight_N:
            return ""
        expected = f"expected {self._weight_N:.1f} N +- {self._section.hover_share:.0%}"
        why = "as it carries itself and its part of the load"
        got = f"got {self._mean_N:.1f} N; see masses, vehicles.thrust_N and the curve of throttle"
        return f"thrust of its hover: {expected}, {why}, {got}"

    def rising(self, told: AutopilotState) -> str:
        """Return that the thrust on the stand does not carry the UAV yet; nothing where it is never told."""
        if not self._autopilot.tells_thrust:
            return ""
        if told.thrust_N is None:
            return _NO_THRUST
        if told.thrust_N >= _CARRIES * self._weight_N:
            return ""
        return f"its motors are on their way: {told.thrust_N:.1f} N of {self._weight_N:.1f} N"
