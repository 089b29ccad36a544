"""A run as its plant sees it: with the bodies as they are, and the section of the plant."""

from dataclasses import dataclass

from transport.model.physics.obstacles import Obstacle
from transport.protocol.scenario.sections.plant_sections import PlantSection
from transport.protocol.scenario.sections.schema import SystemSection
from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.protocol.scenario.setup.team_run import TeamRun


@dataclass(frozen=True, slots=True, kw_only=True)
class HiddenObstacle:
    """An obstacle that agents do not know before a UAV of their own is near."""

    number: int  # in the scenario, from 1
    obstacle: Obstacle
    seen_within_m: float  # distance of its surface from the UAV


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantRun:
    """A run as its plant sees it, which knows what controllers do not.

    The runtimes make it of a scenario (`transport.flight.roles.plant_run`).
    """

    run: TeamRun  # as controllers assume the team
    section: PlantSection  # integration, mismatch, wind, noise, motors
    bodies: SystemSection  # with their actual drag, which controllers need not know
    vehicles: VehiclesSection  # settings of autopilots
    hidden: tuple[HiddenObstacle, ...] = ()
