"""Rules of a run: its length, agents, clock, links and faults, without the team that it moves."""

from dataclasses import dataclass
from functools import cached_property

from transport.protocol.scenario.faults.faults_by_tick import Fault
from transport.protocol.scenario.links.delay_jitter_and_loss import Link
from transport.protocol.scenario.sections.link_sections import LinksSection
from transport.protocol.scenario.sections.lockstep_and_realtime_section import ClockSection
from transport.protocol.wire.node_interface import RunShape


@dataclass(frozen=True, kw_only=True)
class RunRules:
    """Rules of a run, equal in all its processes and in force from its first tick to its last.

    They are what a process needs to take part in ticks and messages: no body, no path and no
    controller. Links change during a run by messages, not here.
    """

    name: str  # of the scenario
    digest: str  # fingerprint of the scenario: processes of different ones refuse each other
    shape: RunShape  # of the messages, with ticks, period, agents and their UAVs
    seed: int  # of all random numbers
    clock: ClockSection
    links: LinksSection
    faults: tuple[Fault, ...] = ()  # scripted, in the order of time
    has_plant: bool = True  # whether a process simulates the team

    @property
    def has_vehicles(self) -> bool:
        """Whether each UAV has a process that measures and acts by an autopilot."""
        return self.shape.by_vehicles

    @cached_property
    def agents(self) -> tuple[int, ...]:
        """Agent ids, 1-based."""
        return tuple(self.shape.owned)

    @cached_property
    def owned(self) -> tuple[tuple[int, ...], ...]:
        """UAVs of agent 1, agent 2, ..., 0-based."""
        return tuple(tuple(uav - 1 for uav in uavs) for uavs in self.shape.owned.values())

    @property
    def uavs(self) -> int:
        """Number of UAVs."""
        return self.shape.uavs

    @property
    def ticks(self) -> int:
        """Sampling instants of the run: t_k < duration of the maneuver."""
        return self.shape.ticks

    @property
    def period_s(self) -> float:
        """Sampling period, s."""
        return self.shape.period_s

    @property
    def period_ns(self) -> int:
        """Sampling period, ns."""
        return round(self.shape.period_s * 1e9)

    def link(self, sender: str, receiver: str) -> Link:
        """Return the link that carries one process's messages to another.

        Plans, or measurements from the plant.
        """
        return Link(self.links, sender, receiver, seed=self.seed, period_s=self.period_s)
