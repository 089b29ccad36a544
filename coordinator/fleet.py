"""The vehicles of a run before and during the flight, as the coordinator knows them.

In PREPARING (`coordinator.state_machine`) vehicles tell their phase and problem, five times a second, and
each answer to a word of the coordinator measures the offset of its clock. Once all are ready, in
their places and with one time, the instant of tick 0 is told, a second ahead: STARTING.
"""

import math
from itertools import combinations

import numpy as np

from transport.model.arrays import Array
from transport.protocol.admission.told_changes import ToldChanges
from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.protocol.wire.messages import Schedule, VehicleStatus
from transport.protocol.wire.outbox import Outbox

# Time between two words to the vehicles before tick 0, and from the decision to tick 0, ns.
_EVERY_NS = 200_000_000
_AHEAD_NS = 1_000_000_000
# Longest time in which a coordinator that returns learns what an earlier one has told, ns.
_LEARNS_NS = 5_000_000_000
READY = "ready"  # `vehicle.node.VehiclePhase`


class Fleet:
    """Newest status of each vehicle, by UAV, 1-based; times are ns of a steady clock.

    places_I: Positions of the UAVs at the start of the maneuver, (N, 3), m.
    wall_offset_ns: The common clock less the steady one, ns.
    told: Targets and changes of links so far.

    Attributes:
        start_ns: Instant of tick 0 by the common clock, 0 before it is decided.
        next_ns: When the next word is due.
    """

    def __init__(
        self,
        section: VehiclesSection,
        places_I: Array,
        out: Outbox,
        wall_offset_ns: int,
        told: ToldChanges,
    ) -> None:
        self._section = section
        self._places_I = places_I
        self._out = out
        self._wall_offset_ns = wall_offset_ns
        self._told = told
        self._status: dict[int, VehicleStatus] = {}
        # Offset of each clock and its uncertainty, s: of the exchange that took least time.
        self._offsets: dict[int, tuple[float, float]] = {}
        self._began_ns: int | None = None
        self.start_ns = 0
        self.next_ns = 0

    @property
    def steady_start_ns(self) -> int:
        """Instant of tick 0 by the steady clock."""
        return self.start_ns - self._wall_offset_ns

    def take(self, status: VehicleStatus, now_ns: int) -> None:
        """Take in a status.

        The offset of its clock is ((t2 - t1) + (t3 - t4)) / 2, where t1 is when the coordinator sent,
        t2 and t3 are when the vehicle received and answered, by its clock, and t4 is now. It is
        wrong by at most half the time on the way, (t4 - t1) - (t3 - t2).
        """
        self._status[status.uav] = status
        self._told.note(status, now_ns)
        if not status.heard_ns:
            return
        t4 = now_ns + self._wall_offset_ns
        there_ns = status.heard_at_ns - status.heard_ns
        back_ns = status.sent_ns - t4
        offset_s = (there_ns + back_ns) / 2e9
        doubt_s = (there_ns - back_ns) / 2e9
        if doubt_s < self._offsets.get(status.uav, (0.0, math.inf))[1]:
            self._offsets[status.uav] = offset_s, doubt_s

    def speak(self, now_ns: int) -> Schedule | None:
        """Return the word that is due, and decide tick 0 once nothing is missing."""
        if self._began_ns is None:
            self._began_ns = now_ns
        if now_ns < self.next_ns:
            return None
        self.next_ns = now_ns + _EVERY_NS
        if not self.start_ns and not self.problem():
            self.start_ns = now_ns + self._wall_offset_ns + _AHEAD_NS
        return self.word(now_ns)

    def word(self, now_ns: int) -> Schedule:
        """Return the instants of the ticks, as far as they are decided."""
        sent_ns = now_ns + self._wall_offset_ns
        return self._out.stamp(
            Schedule, tick=0, sent_ns=sent_ns, start_ns=self.start_ns, **self._told.counts
        )

    def learns(self, now_ns: int) -> bool:
        """Return whether vehicles still have to say what an earlier coordinator has told."""
        began_ns = now_ns if self._began_ns is None else self._began_ns
        return self._told.lacks() and now_ns < began_ns + _LEARNS_NS

    def follow(self) -> None:
        """Take the instant of tick 0 that the vehicles follow already."""
        self.start_ns = self.followed_ns

    def is_over(self, now_ns: int) -> bool:
        """Return whether the time is over in which vehicles have to be ready."""
        waited_ns = now_ns - (now_ns if self._began_ns is None else self._began_ns)
        return not self.start_ns and waited_ns > self._section.ready_s * 1e9

    def problem(self) -> str:
        """Return what keeps the team from its first tick, empty if nothing does."""
        for uav in range(1, len(self._places_I) + 1):
            status = self._status.get(uav)
            if status is None:
                return f"vehicle{uav}: no word from it"
            if status.phase != READY:
                return f"vehicle{uav} is {status.phase}: {status.problem}"
            offset_s, doubt_s = self._offsets.get(uav, (0.0, math.inf))
            most_s = self._section.clock_offset_s
            if not abs(offset_s) + doubt_s <= most_s:
                limit = f"expected at most {1e3 * most_s:g} ms with its uncertainty"
                got = f"got {1e3 * offset_s:+.1f} ms +- {1e3 * doubt_s:.1f} ms"
                return f"vehicle{uav}: clock: {limit}, {got}"
        return self._misplaced()

    def _misplaced(self) -> str:
        """Return which distance of two UAVs, or of one from its place, does not fit a hover; empty if all do."""
        wanted = self._places_I
        for one, other in combinations(range(len(wanted)), 2):
            expected_m = float(np.linalg.norm(wanted[one] - wanted[other]))
            apart = self._status[one + 1].position - self._status[other + 1].position
            got_m = float(np.linalg.norm(apart))
            if abs(got_m - expected_m) > self._section.distance_m:
                expected = f"expected {expected_m:.2f} m +- {self._section.distance_m:g} m"
                where = "between their positions, as the rods hold them"
                return f"UAV{one + 1} and UAV{other + 1}: {expected} {where}, got {got_m:.2f} m"
        for uav, place in enumerate(wanted, start=1):
            off_m = float(np.linalg.norm(self._status[uav].position - place))
            if off_m > 2.0 * self._section.distance_m:
                most = f"expected within {2.0 * self._section.distance_m:g} m"
                return (
                    f"UAV{uav}: {most} of its place at the start of the maneuver, got {off_m:.2f} m"
                )
        return ""

    @property
    def roster(self) -> int:
        """Newest version of a roster that a vehicle has."""
        return max((status.roster for status in self._status.values()), default=0)

    @property
    def followed_ns(self) -> int:
        """Instant of tick 0 that vehicles follow, by the common clock; 0 before."""
        return max((status.start_ns for status in self._status.values()), default=0)
