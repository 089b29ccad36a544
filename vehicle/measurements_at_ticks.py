"""Measurements of one autopilot at the ticks: moved on to their instants, in one frame for the whole flight."""

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.vehicle.autopilot import AutopilotState


class TickMeasurements:
    """Measurements at the ticks, and why there are none.

    The estimate of an autopilot may jump, as its receiver does. Places of the team would then no longer fit
    the rods: a jump is taken out of all positions after it.

    speed: Seconds of the run in a second of wall time.

    Attributes:
        shift_I: Sum of the jumps, to be added to positions by the autopilot, (3,), m.
        problem: Why there is no measurement at the newest tick, or what is wrong with it; empty if nothing is.
    """

    def __init__(self, section: VehiclesSection, speed: float) -> None:
        self._section = section
        self._speed = speed
        self.shift_I = np.zeros(3)
        self.problem = ""
        # Newest position by the autopilot, (3,), m, and its time by the autopilot's clock, s.
        self._last: tuple[Array, float] | None = None

    def at(self, told: AutopilotState | None, at_ns: int) -> tuple[Array | None, float]:
        """Return the measurements at an instant, (15,), and their age, s; None without valid ones.

        Position and attitude go on at their rates from their arrival to the instant.
        """
        if told is None or told.sensed is None:
            self.problem = "no state from the autopilot"
            return None, -1.0
        moved_s = self._speed * (at_ns - told.position_ns) / 1e9
        turned_s = self._speed * (at_ns - told.attitude_ns) / 1e9
        age_s = max(moved_s, turned_s)
        if age_s > self._section.stale_s:
            self.problem = f"state of the autopilot {age_s:.2f} s old"
            return None, age_s
        if not told.is_healthy:
            self.problem = f"the autopilot's estimate is not valid: {told.says}".strip(": ")
            return None, age_s

        sensed = told.sensed.copy()
        self._note_jump(sensed, told.position_s)
        sensed[state.POSITION] += self.shift_I + moved_s * sensed[state.VELOCITY]
        sensed[state.THETA] += turned_s * sensed[state.OMEGA]
        return sensed, max(age_s, 0.0)

    def _note_jump(self, sensed: Array, at_s: float) -> None:
        """Add a change of the position that is no motion to the jumps.

        at_s: Time of the measurements by the autopilot's clock: that of their arrival tells nothing
            about a motion after this process was stopped, or the link silent.
        """
        place = sensed[state.POSITION].copy()
        if self._last is not None:
            passed_s = at_s - self._last[1]
            moved = passed_s * sensed[state.VELOCITY]
            jump = place - self._last[0] - moved
            # After a silence a UAV may have moved that far: its velocity then says nothing about it.
            is_next = 0.0 <= passed_s <= self._section.stale_s
            if is_next and np.linalg.norm(jump) > self._section.jump_m:
                self.shift_I = self.shift_I - jump
        self._last = place, at_s

        far_m = float(np.linalg.norm(self.shift_I))
        self.problem = f"the autopilot's position has jumped by {far_m:.1f} m" if far_m else ""
