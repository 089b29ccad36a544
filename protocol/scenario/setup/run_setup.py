"""Objects of a run, built from its scenario by every process, identically."""

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

import numpy as np

from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.path.flat_reference import FlatReference, Track
from transport.model.path.hover_reference import Reference as HoverReference
from transport.model.path.maneuver import Maneuver
from transport.model.path.target_and_stop import Slowing, Target
from transport.model.physics.hover import Hover, hover
from transport.model.physics.obstacles import Obstacle
from transport.model.physics.parameters import ParameterError, System
from transport.mpc.law.hover_law import Crew
from transport.mpc.law.present_law import Regulation, WholeTeam
from transport.mpc.margins.design_of_gains_alone import AloneDesign, TeamAlone
from transport.mpc.program.user_expressions import check_constraints, check_costs
from transport.mpc.reference import Reference
from transport.mpc.settings import ControllerSettings
from transport.protocol.scenario.checks.reference_limits import (
    Problems,
    blocked,
    off_ground,
    off_hover,
    off_limits,
    too_close_at_hover,
    touching_at_hover,
)
from transport.protocol.scenario.faults.faults_of_scenario import scripted
from transport.protocol.scenario.faults.scripted_faults import Fault, failures
from transport.protocol.scenario.sections.run_size import ticks_of
from transport.protocol.scenario.sections.scenario_errors import HoverError, ScenarioError
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.acting_alone import check_design, hands_over, may_act_alone
from transport.protocol.scenario.setup.collisions import Contacts
from transport.protocol.scenario.setup.model_objects import (
    building,
    maneuver_of,
    obstacle_of,
    system_of,
)
from transport.protocol.scenario.setup.run_rules import RunRules
from transport.protocol.scenario.targets.target_messages import check_scripted, target_of
from transport.protocol.wire.messages import Target as TargetMessage
from transport.protocol.wire.node_interface import RunShape

_REMEDY = (
    "slowing does not help: move the path or the obstacle, "
    "or lean the rods (maneuver.phase.formation)"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSheet:
    """Data sheet of the vehicles' own sensors.

    Position, velocity, attitude, body rates, specific force.
    """

    vehicle: bool  # whether agents have these sensors, not states
    noise: Array  # standard deviations, (5,), SI
    bias: Array  # standard deviations of the constant errors, (5,), SI
    ages: tuple[int, ...]  # sampling periods from a quantity to its measurement


@dataclass(frozen=True, kw_only=True)
class Setup:
    """A scenario turned into a system, a maneuver and controller settings."""

    scenario: Scenario
    rules: RunRules  # all that does not depend on the team and its path
    system: System
    hover: Hover  # at the origin
    model: Model  # equations of motion, compiled when they are first evaluated
    reference: Reference  # with the targets so far
    settings: ControllerSettings  # the same for every agent
    # Design of the law of UAVs alone, whose gains `settings` has; None where none of them acts alone.
    alone: AloneDesign | None = None

    @staticmethod
    def of(scenario: Scenario, source: str) -> "Setup":
        """Return everything a scenario describes.

        Raises: ScenarioError: the scenario is impossible; the text names the source.
        """
        system = system_of(scenario, source)
        equilibrium = building(source, "system.uav", lambda: hover(system), HoverError)
        maneuver = building(source, "maneuver", lambda: maneuver_of(scenario))

        # 1/M of M agents: the descent guarantee of cooperative distributed MPC (docs/decisions.md).
        share = scenario.controller.relaxation
        if share == "auto":
            share = 1.0 / len(scenario.owned)
        settings = scenario.controller.model_copy(update={"relaxation": share})

        is_flat = scenario.maneuver.reference == "flat"
        path = (FlatReference if is_flat else HoverReference)(system, equilibrium, maneuver)
        instants = ticks_of(scenario) + settings.horizon + 2
        setup = Setup(
            scenario=scenario,
            rules=rules_of(scenario),
            system=system,
            hover=equilibrium,
            model=Model(system),
            reference=Reference(path, settings.sampling_period_s, instants),
            settings=settings,
        )
        setup._check(source)
        return setup._with_gains_alone(source)

    def _with_gains_alone(self, source: str) -> "Setup":
        """Return the run with the gains of UAVs alone that are designed for its team.

        Raises: ScenarioError: UAVs act alone in this run, and no gains hold the team.
        """
        if not may_act_alone(self.scenario):
            return self
        design = self.team_alone(next_tick=self.scenario.clock.next_tick).design()
        check_design(self.scenario, source, design)
        settings = self.settings.model_copy(update={"alone": design.gains})
        return replace(self, settings=settings, alone=design)

    def team_alone(self, *, next_tick: bool) -> TeamAlone:
        """Return the team whose UAVs may act alone; with `next_tick` inputs act a period later."""
        settings = self.settings.model_copy(update={"alone": self.scenario.controller.alone})
        team_gain = None
        # The regulator with known motor lag is of more states than UAVs alone have.
        if hands_over(self.scenario) and settings.motor_lag_s == 0.0:
            team_gain = Regulation(self.model, self.hover, settings).gain(0)
        return TeamAlone(
            system=self.system,
            settings=settings,
            next_tick=next_tick,
            ages=self.sensors.ages if self.sensors.vehicle else None,
            team_gain=team_gain,
            left=tuple(self._left_after_releases()),
        )

    def _left_after_releases(self) -> Iterator[System]:
        """Yield the bodies that carry the payload after each scripted release, in the order of time.

        A released UAV pulls with nothing: those left are a smaller team.
        """
        released: dict[int, frozenset[int]] = {}  # by tick, after all releases of that tick
        gone: frozenset[int] = frozenset()
        for fault in failures(self.faults):
            if fault.do == "release":
                gone |= {fault.uav}
                released[fault.tick] = gone
        for off in released.values():
            uavs = [uav for i, uav in enumerate(self.system.uavs) if i not in off]
            if not uavs:
                continue
            with contextlib.suppress(ParameterError):  # these cannot hover: no law holds them
                left = replace(self.system, uavs=tuple(uavs))
                hover(left)
                yield left

    def _check(self, source: str) -> None:
        """Check that controllers exist, and that hover, reference and targets keep the limits.

        Raises: ScenarioError: the first that does not.
        """
        settings, system, at_rest = self.settings, self.system, self.hover
        building(
            source,
            "controller.constraint",
            lambda: check_constraints(settings.constraint, system, self.initial_state(), at_rest.u),
        )
        building(source, "controller.cost", lambda: check_costs(settings.cost, system, at_rest.x))
        building(source, "controller.prediction", lambda: Regulation(self.model, at_rest, settings))

        plant = self.scenario.plant
        for field, problem in off_ground(system, self.maneuver, plant.ground_m):
            raise ScenarioError(source, field, problem)
        for field, problem in off_hover(at_rest, settings, plant):
            raise HoverError(source, field, problem)
        for field, problem in chain(
            too_close_at_hover(self.model, at_rest, settings),
            touching_at_hover(
                self.model, at_rest, [uav.radius_m for uav in self.scenario.system.uav]
            ),
            off_limits(self.reference, system, at_rest, settings, self.faults),
            self._off_obstacles(),
        ):
            raise ScenarioError(source, field, problem)
        # A flat reference has a track once the checks above have passed.
        track = self.reference.sampled.track
        if track is not None:
            building(
                source,
                "controller.cost",
                lambda: check_costs(settings.cost, system, at_rest.x, track.X),
            )
        building(source, "maneuver.target", lambda: check_scripted(self))

    def _off_obstacles(self) -> Problems:
        """Yield the obstacle whose margins the reference does not keep, between instants too."""
        first = blocked(self.reference, self.obstacles, self.system)
        if first is not None:
            number, problem = first
            yield f"obstacle.{number}", f"{problem}; {_REMEDY}"

    @cached_property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Obstacles, in the order of the file."""
        return tuple(obstacle_of(section) for section in self.scenario.obstacle)

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

    def by_clock_of(self, agent: int) -> "Setup":
        """Return the run as an agent, 1-based, follows it by its own clock."""
        offsets_s = self.scenario.clock.offsets_s
        if not offsets_s or offsets_s[agent - 1] == 0.0:
            return self
        return replace(self, reference=self.reference.by_clock(offsets_s[agent - 1]))

    def with_target(self, target: Target) -> "Setup":
        """Return the run with a further target; before it, the reference stays as it was."""
        return replace(self, reference=self.reference.with_target(target))

    def with_slowing(self, slowing: Slowing) -> "Setup":
        """Return the run along whose path time is lost."""
        return replace(self, reference=self.reference.with_slowing(slowing))

    def after(self, targets: Iterable[TargetMessage]) -> "Setup":
        """Return the run with those targets that follow its own, each once, by their numbers.

        That is the path as the coordinator tells it; agents may know a part (`KnownTargets`).
        """
        setup = self
        for message in targets:
            if message.number == len(setup.maneuver.targets) + 1:
                setup = setup.led_to(message)
        return setup

    def led_to(self, message: TargetMessage) -> "Setup":
        """Return the run with the target of a message."""
        period_s = self.settings.sampling_period_s
        has_ground = self.scenario.plant.ground_m is not None
        return self.with_target(target_of(message, period_s, has_ground=has_ground))

    def whole_team(self) -> WholeTeam:
        """Return the law of the whole team, with the fail-safe of UAVs whose plans have run out."""
        crew = Crew(self.model, self.hover, self.settings)
        return WholeTeam(crew, self.reference.sampled)

    @cached_property
    def sensors(self) -> SensorSheet:
        """Data sheet of the vehicles' own sensors, which the filters of the agents know."""
        noise = self.scenario.plant.noise
        period_s = self.settings.sampling_period_s
        quantities = type(noise.bias).model_fields
        delays_s = noise.delay.model_dump().values()
        return SensorSheet(
            vehicle=self.scenario.plant.sensors == "vehicle",
            noise=np.array([getattr(noise, quantity) for quantity in quantities]),
            bias=np.array(list(noise.bias.model_dump().values())),
            ages=tuple(round(delay_s / period_s) for delay_s in delays_s),
        )

    @property
    def agents(self) -> tuple[int, ...]:
        """Agent ids, 1-based."""
        return self.rules.agents

    @property
    def owned(self) -> tuple[tuple[int, ...], ...]:
        """UAVs of agent 1, agent 2, ..., 0-based."""
        return self.rules.owned

    @property
    def ticks(self) -> int:
        """Sampling instants of the run: t_k < duration of the maneuver."""
        return self.rules.ticks

    @property
    def period_ns(self) -> int:
        """Sampling period, ns."""
        return self.rules.period_ns

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Scripted faults, in the order of time."""
        return self.rules.faults

    def contacts(self) -> Contacts:
        """Return what tells the first contact of two UAVs of this run."""
        return Contacts(
            self.positions_I,
            [uav.radius_m or 0.0 for uav in self.scenario.system.uav],
            self.faults,
            self.settings.sampling_period_s,
        )

    def positions_I(self, x: Array) -> Array:
        """Return the positions of the UAVs in a state of the plant, (N, 3), m."""
        return self.model.outputs(x)[: 3 * self.system.N].reshape(-1, 3)

    def initial_state(self) -> np.ndarray:
        """Return the state of hover at the start of the maneuver, at rest, (12 + 12 N,)."""
        x = self.hover.x.copy()
        x[:3] += self.maneuver.start_I
        return x


def rules_of(scenario: Scenario) -> RunRules:
    """Return the rules of a run."""
    settings = scenario.controller
    owned = dict(enumerate(scenario.owned, start=1))
    limits = {
        agent: (settings.lower(len(uavs)), settings.upper(len(uavs)))
        for agent, uavs in owned.items()
    }
    shape = RunShape(
        owned=owned,
        limits=limits,
        uavs=len(scenario.system.uav),
        ticks=ticks_of(scenario),
        period_s=settings.sampling_period_s,
        delay=1 if scenario.clock.next_tick else 0,
        negotiation_iterations=settings.negotiation_iterations,
        vehicle_sensors=scenario.plant.sensors == "vehicle",
        # The coordinator, which waits for all plans, hands them on.
        relayed=scenario.clock.mode == "lockstep",
        by_vehicles=scenario.has_vehicles,
        confirms=settings.targets == "confirmed",
    )
    return RunRules(
        digest=scenario.digest(),
        shape=shape,
        seed=scenario.seed,
        clock=scenario.clock,
        links=scenario.links,
        faults=scripted(scenario),
        has_plant=scenario.has_plant,
    )
