"""Properties of a run that the timing of its targets needs."""

from collections.abc import Iterable
from typing import Protocol, Self

from transport.model.path.maneuver import Maneuver
from transport.model.path.target_and_stop import PathTarget
from transport.model.physics.hover import Hover
from transport.model.physics.obstacles import Obstacle
from transport.model.physics.parameters import System
from transport.mpc.reference import Reference
from transport.mpc.settings_period_horizon_weights import ControllerSettings
from transport.protocol.scenario.faults.faults_by_tick import Fault
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.wire import messages


class PlannedRun(Protocol):
    """A run, such as `setup.Setup`, for which targets are timed."""

    @property
    def scenario(self) -> Scenario:
        """The validated scenario."""
        ...

    @property
    def system(self) -> System:
        """The team and its payload."""
        ...

    @property
    def hover(self) -> Hover:
        """Hover at the origin."""
        ...

    @property
    def settings(self) -> ControllerSettings:
        """Settings of every controller, with the sampling period and the limits."""
        ...

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Scripted faults, in the order of time."""
        ...

    @property
    def maneuver(self) -> Maneuver:
        """Path of the payload with the targets so far."""
        ...

    @property
    def reference(self) -> Reference:
        """Reference outputs and states."""
        ...

    @property
    def known_obstacles(self) -> tuple[Obstacle, ...]:
        """Obstacles that all know from the start, in the order of the file."""
        ...

    @property
    def ticks(self) -> int:
        """Number of sampling instants of the run."""
        ...

    def with_target(self, target: PathTarget) -> Self:
        """Return the run with a further target."""
        ...

    def after(self, targets: Iterable[messages.Target]) -> Self:
        """Return the run with the targets of messages that follow its own."""
        ...
