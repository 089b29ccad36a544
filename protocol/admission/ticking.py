"""Instants of the ticks by the common clock, for a process that ticks by itself."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Ticking:
    """Tick k is at `start_ns` + k T_s / speed; times are ns of a steady clock of this process."""

    start_ns: int
    period_ns: int
    speed: float

    @staticmethod
    def of(schedule_ns: int, period_ns: int, speed: float, wall_offset_ns: int) -> "Ticking":
        """Return the instants of a schedule, ns since 1970.

        wall_offset_ns: The common clock less the steady one of this process, ns.
        """
        return Ticking(start_ns=schedule_ns - wall_offset_ns, period_ns=period_ns, speed=speed)

    def due_ns(self, tick: float) -> int:
        """Return the instant of a tick, or of a part of one."""
        return self.start_ns + round(tick * self.period_ns / self.speed)

    def ticks(self, now_ns: int) -> float:
        """Return the ticks since tick 0, with their parts; negative before it."""
        return (now_ns - self.start_ns) * self.speed / self.period_ns

    def newest(self, now_ns: int) -> int:
        """Return the newest tick whose instant has come; -1 before the first."""
        return max(math.floor(self.ticks(now_ns)), -1)
