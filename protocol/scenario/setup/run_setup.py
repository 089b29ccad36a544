"""Objects of a run, built from its scenario by every process, identically."""

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.path.flat_reference import FlatReference, Track
from transport.model.path.hover_reference import HoverReference as HoverReference
from transport.model.path.maneuver import Maneuver
from transport.model.path.target_and_stop import PathTarget
from transport.model.physics.hover import Hover, hover
from transport.model.physics.obstacles import Obstacle
from transport.model.physics.parameters import ParameterError, System
from transport.mpc.law.present_law import Regulation, WholeTeam
from transport.mpc.margins.design_of_gains_alone import AloneDesign, TeamAlone
from transport.mpc.program.user_expressions import check_constraints, check_costs
from transport.mpc.reference import Reference
from transport.protocol.scenario.checks.reference_limits import (
    Problems,
    blocked,
    off_ground,
    off_hover,
    off_limits,
    too_close_at_hover,
    touching_at_hover,
)
from transport.protocol.scenario.faults.faults_by_tick import Fault, failures
from transport.protocol.scenario.faults.faults_from_sections import scripted
from transport.protocol.scenario.sections.limits_on_size import ticks_of
from transport.protocol.scenario.sections.scenario_errors import HoverError, ScenarioError
from transport.protocol.scenario.sections.schema import ControllerSection, Scenario
from transport.protocol.scenario.setup.acting_alone import check_design, hands_over, may_act_alone
from transport.protocol.scenario.setup.collisions import Contacts
from transport.protocol.scenario.setup.model_objects import (
    building,
    maneuver_of,
    obstacle_of,
    system_of,
)
from transport.protocol.scenario.setup.run_rules import RunRules
from transport.protocol.scenario.setup.team_run import Knowledge, SensorSheet, TeamOnPath, TeamRun
from transport.protocol.scenario.targets.target_messages import check_scripted
from transport.protocol.wire.messages import Target as TargetMessage
from transport.protocol.wire.node_interface import RunShape

_REMEDY = (
    "slowing does not help: move the path or the obstacle, "
    "or lean the rods (maneuver.phase.formation)"
)


@dataclass(frozen=True, kw_only=True)
class Setup:
    """A scenario and what follows from it, by purpose; only the runtimes hold it.

    A role takes the part that it uses (`transport.flight.roles`): the coordinator `run.rules`, agents
    and vehicles `run`, the plant also its section.
    """

    scenario: Scenario
    run: TeamRun  # rules, the team on its path with the targets so far, what controllers know
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

        # 1/M of M agents: the descent guarantee of cooperative distributed MPC (docs/record/decisions.md).
        share = scenario.controller.relaxation
        if share == "auto":
            share = 1.0 / len(scenario.owned)
        settings = scenario.controller.model_copy(update={"relaxation": share})

        is_flat = scenario.maneuver.reference == "flat"
        path = (FlatReference if is_flat else HoverReference)(system, equilibrium, maneuver)
        instants = ticks_of(scenario) + settings.horizon + 2
        team = TeamOnPath(
            system=system,
            hover=equilibrium,
            model=Model(system),
            reference=Reference(path, settings.sampling_period_s, instants),
            has_ground=scenario.plant.ground_m is not None,
        )
        known = Knowledge(
            settings=settings,
            sensors=_sensors_of(scenario),
            obstacles=tuple(
                obstacle_of(section)
                for section in scenario.obstacle
                if section.seen_within_m is None
            ),
            controllers=scenario.controllers,
            radio=scenario.radio,
        )
        run = TeamRun(rules=rules_of(scenario), team=team, known=known)
        setup = Setup(scenario=scenario, run=run)
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
        known = replace(self.run.known, settings=settings)
        return replace(self, run=replace(self.run, known=known), alone=design)

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
            remaining=tuple(self._remaining_after_releases()),
        )

    def _remaining_after_releases(self) -> Iterator[System]:
        """Yield the bodies that carry the payload after each scripted release, in the order of time.

        A released UAV pulls with nothing: those remaining are a smaller team.
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
                remaining = replace(self.system, uavs=tuple(uavs))
                hover(remaining)
                yield remaining

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
        first = blocked(self.reference, self.run.obstacles, self.system)
        if first is not None:
            number, problem = first
            sections = enumerate(self.scenario.obstacle, start=1)
            numbers = [number for number, section in sections if section.seen_within_m is None]
            yield f"obstacle.{numbers[number - 1]}", f"{problem}; {_REMEDY}"

    @property
    def rules(self) -> RunRules:
        """Rules of the run: all that does not depend on the team and its path."""
        return self.run.rules

    @property
    def system(self) -> System:
        """Bodies of the team as the controllers assume them."""
        return self.run.system

    @property
    def hover(self) -> Hover:
        """Hover at the origin."""
        return self.run.hover

    @property
    def model(self) -> Model:
        """Equations of motion."""
        return self.run.model

    @property
    def reference(self) -> Reference:
        """Reference with the targets so far."""
        return self.run.reference

    @property
    def settings(self) -> ControllerSection:
        """Settings of every controller."""
        return self.run.settings

    @property
    def sensors(self) -> SensorSheet:
        """Data sheet of the vehicles' own sensors."""
        return self.run.sensors

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """All obstacles, also those that only sight tells, in the order of the file."""
        return tuple(obstacle_of(section) for section in self.scenario.obstacle)

    @property
    def known_obstacles(self) -> tuple[Obstacle, ...]:
        """Obstacles that all know from the start."""
        return self.run.obstacles

    @property
    def maneuver(self) -> Maneuver:
        """Path of the payload, with the targets so far."""
        return self.run.maneuver

    @property
    def track(self) -> Track | None:
        """States and inputs along a flat reference at the sampling instants; else None."""
        return self.run.track

    @property
    def Y_ref(self) -> Array:
        """Reference outputs at every instant that any horizon reaches, (K, 4 N + 9)."""
        return self.run.Y_ref

    @property
    def X_ref(self) -> Array:
        """Reference states at the same instants, (K, n)."""
        return self.run.X_ref

    @property
    def agents(self) -> tuple[int, ...]:
        """Agent ids, 1-based."""
        return self.run.rules.agents

    @property
    def owned(self) -> tuple[tuple[int, ...], ...]:
        """UAVs of agent 1, agent 2, ..., 0-based."""
        return self.run.rules.owned

    @property
    def ticks(self) -> int:
        """Sampling instants of the run: t_k < duration of the maneuver."""
        return self.run.rules.ticks

    @property
    def period_ns(self) -> int:
        """Sampling period, ns."""
        return self.run.rules.period_ns

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Scripted faults, in the order of time."""
        return self.run.rules.faults

    def with_target(self, target: PathTarget) -> "Setup":
        """Return the run with a further target; before it, the reference stays as it was."""
        return replace(self, run=self.run.with_target(target))

    def after(self, targets: Iterable[TargetMessage]) -> "Setup":
        """Return the run with those targets that follow its own, as the coordinator tells them."""
        return replace(self, run=self.run.after(targets))

    def whole_team(self) -> WholeTeam:
        """Return the law of the whole team, with the fail-safe of UAVs whose plans have run out."""
        return self.run.whole_team()

    def contacts(self) -> Contacts:
        """Return what tells the first contact of two UAVs of this run."""
        return Contacts(
            self.run.positions_I,
            [uav.radius_m or 0.0 for uav in self.scenario.system.uav],
            self.faults,
            self.rules.period_s,
        )

    def initial_state(self) -> Array:
        """Return the state of hover at the start of the maneuver, at rest, (12 + 12 N,)."""
        return self.run.initial_state()


def _sensors_of(scenario: Scenario) -> SensorSheet:
    """Return the data sheet of the vehicles' own sensors."""
    noise = scenario.plant.noise
    period_s = scenario.controller.sampling_period_s
    quantities = type(noise.bias).model_fields
    delays_s = noise.delay.model_dump().values()
    return SensorSheet(
        vehicle=scenario.plant.sensors == "vehicle",
        noise=np.array([getattr(noise, quantity) for quantity in quantities]),
        bias=np.array(list(noise.bias.model_dump().values())),
        ages=tuple(round(delay_s / period_s) for delay_s in delays_s),
    )


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
        sights=sum(section.seen_within_m is not None for section in scenario.obstacle),
    )
    return RunRules(
        name=scenario.name,
        digest=scenario.digest(),
        shape=shape,
        seed=scenario.seed,
        clock=scenario.clock,
        links=scenario.links,
        faults=scripted(scenario),
        has_plant=scenario.has_plant,
    )
