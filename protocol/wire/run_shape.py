"""What the messages of a run must fit: its agents, its sizes, its limits."""

from collections.abc import Mapping
from dataclasses import dataclass

from model.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class RunShape:
    """Shape of a run, from its scenario (`protocol.scenario.setup.Setup.shape`)."""

    owned: Mapping[int, tuple[int, ...]]  # ids of the UAVs of each agent, both 1-based
    limits: Mapping[int, tuple[Array, Array]]  # smallest and largest inputs of each agent, (4 owned,), SI
    uavs: int
    ticks: int
    delay: int  # ticks from a plan to its first input
    negotiation_iterations: int
    vehicle_sensors: bool  # whether UAVs are told by the measurements of their own sensors, not by states
    relayed: bool  # whether plans come in bundles
