"""Contacts of two UAVs, each a sphere (`system.uav.radius_m`), by the states of the plant."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from transport.model.arrays import Array
from transport.protocol.scenario.faults.faults_by_tick import Fault, failures
from transport.protocol.wire.messages import PlantState

_ROUNDING_M = 1e-6  # more than that of the lengths by which pairs are left out


@dataclass(frozen=True, slots=True, kw_only=True)
class Contact:
    """First moment at which the spheres of two UAVs touch."""

    at_s: float
    uavs: tuple[int, int]  # ids, 1-based
    distance_m: float  # sum of the radii

    @property
    def text(self) -> str:
        """Pair and distance in words."""
        one, other = self.uavs
        return f"UAV{one} and UAV{other} collide, {self.distance_m:g} m apart"


class Contacts:
    """First contact of a run, from its plant states tick by tick.

    Between two ticks UAVs move along straight lines: one that passes through another within a sampling
    period touches it. UAVs without a radius, and released ones, touch nothing.

    positions: Positions of the UAVs in a state of the plant, (N, 3), m.
    radii_m: Radius of each UAV, 0 for none.
    faults: Scripted faults, of which the releases count.

    Attributes:
        first: The first contact so far.
    """

    def __init__(
        self,
        positions: Callable[[Array], Array],
        radii_m: Sequence[float],
        faults: Sequence[Fault],
        period_s: float,
    ) -> None:
        self._positions = positions
        self._period_s = period_s
        self._releases = [
            (fault.tick, fault.uav) for fault in failures(faults) if fault.do == "release"
        ]
        # Pairs, 0-based, and the distances at which they touch.
        self._pairs_m = {
            (i, j): radii_m[i] + radii_m[j]
            for i, j in combinations(range(len(radii_m)), 2)
            if radii_m[i] and radii_m[j]
        }
        self._pairs = np.array([*self._pairs_m], dtype=np.intp).reshape(-1, 2)
        self._distances_m = np.array([*self._pairs_m.values()])
        self._before: tuple[int, Array] | None = None  # tick and positions, (N, 3)
        self.first: Contact | None = None

    def add(self, plant_state: PlantState) -> Contact | None:
        """Take in the next state of the plant; return the first contact if it is between these two."""
        if not self._pairs_m or self.first is not None:
            return None
        tick = plant_state.tick
        r_I = self._positions(plant_state.x)
        # Nothing is known across a gap in the record.
        is_next = self._before is not None and self._before[0] == tick - 1
        start_I = self._before[1] if is_next and self._before is not None else r_I
        self._before = tick, r_I

        released = {uav for since, uav in self._releases if since <= tick}
        contacts = []
        for i, j in self._may_touch(start_I, r_I):
            if not released & {i, j}:
                distance_m = self._pairs_m[i, j]
                share = _first_within(start_I[i] - start_I[j], r_I[i] - r_I[j], distance_m)
                if share is not None:
                    contacts.append((share, i, j))
        if not contacts:
            return None

        share, i, j = min(contacts)
        periods = tick - 1 + share if is_next else tick
        self.first = Contact(
            at_s=float(periods * self._period_s),
            uavs=(i + 1, j + 1),
            distance_m=self._pairs_m[i, j],
        )
        return self.first

    def over(self, states: Iterable[PlantState]) -> Contact | None:
        """Return the first contact of a run from its plant states, ascending; None if there is none."""
        for plant_state in states:
            self.add(plant_state)
        return self.first

    def _may_touch(self, start_I: Array, end_I: Array) -> list[tuple[int, int]]:
        """Return the pairs that are no farther apart than they move: nearly always none."""
        one, other = self._pairs.T
        start = start_I[one] - start_I[other]
        way = end_I[one] - end_I[other] - start
        apart_m = np.sqrt((start**2).sum(axis=1)) - np.sqrt((way**2).sum(axis=1))
        near = self._pairs[apart_m <= self._distances_m + _ROUNDING_M]
        return [(int(i), int(j)) for i, j in near]


def _first_within(start: Array, end: Array, distance: float) -> float | None:
    """Return the first share s of the way at which |start + s (end - start)| <= distance, if any.

    |start|^2 + 2 s start.way + s^2 |way|^2 = distance^2
    """
    way = end - start
    a = float(way @ way)
    b = float(start @ way)
    c = float(start @ start) - distance**2
    if c <= 0.0:
        return 0.0
    discriminant = b * b - a * c
    if b >= 0.0 or discriminant < 0.0:
        return None  # apart, and not coming closer than that
    share = (-b - float(np.sqrt(discriminant))) / a
    return share if share <= 1.0 else None
