"""What the messages of a run must fit: its agents, its sizes, its limits."""

from collections.abc import Mapping
from dataclasses import dataclass

from model.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class RunShape:
    """Shape of a run, from its scenario (`protocol.scenario.setup.Setup.shape`)."""

    owned: Mapping[int, tuple[int, ...]]  # ids of the UAVs of each agent, both 1-based
    limits: Mapping[int, tuple[Array, Array]]  # smallest and largest inputs of each agent, (4 owned,), SI
    ticks: int
    delay: int  # ticks from a plan to its first input
    negotiation_iterations: int
    window: int  # how many ticks another process may be ahead of this one, or behind it
    vehicle_sensors: bool  # whether UAVs are told by the measurements of their own sensors, not by states
    relayed: bool  # whether plans come in bundles
    max_bytes: int  # of a message

    @property
    def uavs(self) -> int:
        """Return the number of UAVs."""
        return sum(map(len, self.owned.values()))
