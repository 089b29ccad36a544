"""A run as agents, plant and vehicles see it: its rules, the team on its path, what controllers know."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.path.flat_reference import Track
from transport.model.path.maneuver import Maneuver
from transport.model.path.target_and_stop import PathTarget, Slowing
from transport.model.physics.hover import Hover
from transport.model.physics.obstacles import Obstacle
from transport.model.physics.parameters import System
from transport.mpc.law.hover_law import Crew
from transport.mpc.law.present_law import WholeTeam
from transport.mpc.reference import Reference
from transport.protocol.scenario.sections.radio_section import RadioSection
from transport.protocol.scenario.sections.schema import ControllerSection
from transport.protocol.scenario.setup.run_rules import RunRules
from transport.protocol.scenario.targets.target_messages import target_of
from transport.protocol.wire.messages import Target as TargetMessage


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSheet:
    """Data sheet of the vehicles' own sensors.

    Position, velocity, attitude, body rates, specific force.
    """

    vehicle: bool  # whether agents have these sensors, not states
    noise: Array  # standard deviations, (5,), SI
    bias: Array  # standard deviations of the constant errors, (5,), SI
    ages: tuple[int, ...]  # sampling periods from a quantity to its measurement


@dataclass(frozen=True, slots=True, kw_only=True)
class TeamOnPath:
    """What the team is: bodies, equations of motion, and the path with the targets so far."""

    system: System
    hover: Hover  # at the origin
    model: Model  # equations of motion, compiled when they are first evaluated
    reference: Reference
    has_ground: bool = False  # whether the payload can land


@dataclass(frozen=True, slots=True, kw_only=True)
class Knowledge:
    """What controllers know beside the team and the rules."""

    settings: ControllerSection  # the same for every agent; `relaxation` is a number
    sensors: SensorSheet
    obstacles: tuple[
        Obstacle, ...
    ] = ()  # but those that only sight tells, in the order of the scenario
    controllers: tuple[str, ...]  # of agent 1, agent 2, ...: `agents.controller`
    radio: RadioSection | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TeamRun:
    """A run as agents, plant and vehicles see it. They need no scenario.

    Rules and knowledge stay; the team's path is led to targets, which makes a new run each time.
    """

    rules: RunRules
    team: TeamOnPath
    known: Knowledge

    @property
    def system(self) -> System:
        """Bodies of the team as the controllers assume them."""
        return self.team.system

    @property
    def hover(self) -> Hover:
        """Hover at the origin."""
        return self.team.hover

    @property
    def model(self) -> Model:
        """Equations of motion."""
        return self.team.model

    @property
    def reference(self) -> Reference:
        """Reference with the targets so far."""
        return self.team.reference

    @property
    def settings(self) -> ControllerSection:
        """Settings of every controller."""
        return self.known.settings

    @property
    def sensors(self) -> SensorSheet:
        """Data sheet of the vehicles' own sensors, which the filters of the agents know."""
        return self.known.sensors

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Obstacles that all know from the start, in the order of the scenario."""
        return self.known.obstacles

    @property
    def owned(self) -> tuple[tuple[int, ...], ...]:
        """UAVs of agent 1, agent 2, ..., 0-based."""
        return self.rules.owned

    @property
    def agents(self) -> tuple[int, ...]:
        """Agent ids, 1-based."""
        return self.rules.agents

    @property
    def ticks(self) -> int:
        """Sampling instants of the run: t_k < duration of the maneuver."""
        return self.rules.ticks

    @property
    def maneuver(self) -> Maneuver:
        """Path of the payload, with the targets so far."""
        return self.reference.maneuver

    @property
    def track(self) -> Track | None:
        """States and inputs along a flat reference at the sampling instants; else None."""
        return self.reference.sampled.track

    @property
    def Y_ref(self) -> Array:
        """Reference outputs at every instant that any horizon reaches, (K, 4 N + 9)."""
        return self.reference.sampled.Y

    @property
    def X_ref(self) -> Array:
        """Reference states at the same instants, (K, n)."""
        return self.reference.sampled.X

    def by_clock_of(self, agent: int) -> "TeamRun":
        """Return the run as an agent, 1-based, follows it by its own clock."""
        offsets_s = self.rules.clock.offsets_s
        if not offsets_s or offsets_s[agent - 1] == 0.0:
            return self
        return self._along(self.reference.by_clock(offsets_s[agent - 1]))

    def with_target(self, target: PathTarget) -> "TeamRun":
        """Return the run with a further target; before it, the reference stays as it was."""
        return self._along(self.reference.with_target(target))

    def with_slowing(self, slowing: Slowing) -> "TeamRun":
        """Return the run along whose path time is lost."""
        return self._along(self.reference.with_slowing(slowing))

    def after(self, targets: Iterable[TargetMessage]) -> "TeamRun":
        """Return the run with those targets that follow its own, each once, by their numbers.

        That is the path as the coordinator tells it; agents may know a part (`KnownTargets`).
        """
        run = self
        for message in targets:
            if message.number == len(run.maneuver.targets) + 1:
                run = run.led_to(message)
        return run

    def led_to(self, message: TargetMessage) -> "TeamRun":
        """Return the run with the target of a message."""
        period_s = self.rules.period_s
        return self.with_target(target_of(message, period_s, has_ground=self.team.has_ground))

    def _along(self, reference: Reference) -> "TeamRun":
        return replace(self, team=replace(self.team, reference=reference))

    def whole_team(self) -> WholeTeam:
        """Return the law of the whole team, with the fail-safe of UAVs whose plans have run out."""
        crew = Crew(self.model, self.hover, self.settings)
        return WholeTeam(crew, self.reference.sampled)

    def positions_I(self, x: Array) -> Array:
        """Return the positions of the UAVs in a state of the plant, (N, 3), m."""
        return self.model.outputs(x)[: 3 * self.system.N].reshape(-1, 3)

    def initial_state(self) -> np.ndarray:
        """Return the state of hover at the start of the maneuver, at rest, (12 + 12 N,)."""
        x = self.hover.x.copy()
        x[:3] += self.maneuver.start_I
        return x
