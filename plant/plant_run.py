"""A run as its plant sees it: with the bodies as they are, and the section of the plant."""

from dataclasses import dataclass, replace

from transport.protocol.scenario.sections.plant_sections import PlantSection
from transport.protocol.scenario.sections.schema import SystemSection
from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.messages import Target


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantRun:
    """A run as its plant sees it, which knows what controllers do not.

    The runtimes make it of a scenario (`transport.flight.roles.plant_run`).
    """

    run: TeamRun  # as controllers assume the team
    section: PlantSection  # integration, mismatch, wind, noise, motors
    bodies: SystemSection  # with their actual drag, which controllers need not know
    vehicles: VehiclesSection  # settings of autopilots

    def led_to(self, message: Target) -> "PlantRun":
        """Return the run with the target of a message."""
        return replace(self, run=self.run.led_to(message))
