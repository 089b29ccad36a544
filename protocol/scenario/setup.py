"""Objects of a run, built from its scenario by every process, identically."""

import math
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import combinations
from typing import Any, Self
from weakref import WeakValueDictionary

import numpy as np

from transport.model.arrays import Array, continued, frozen
from transport.model.curves import Curve
from transport.model.flat import FlatReference, Track
from transport.model.hover import Hover, failed_hover, hover, with_released
from transport.model.linearisation import Model
from transport.model.maneuver import Maneuver, Phase, Reference, Target
from transport.model.obstacles import Obstacle, Solid, bodies, clearances
from transport.model.parameters import ParameterError, Payload, System, Uav, resting_height
from transport.mpc.expressions import UserCosts, compile_constraints
from transport.mpc.fail_safe import FailSafe
from transport.mpc.regulation import KEPT, Ahead, Regulation
from transport.mpc.settings import ControllerSettings
from transport.protocol.scenario.budget import ticks_of
from transport.protocol.scenario.errors import ScenarioError, building
from transport.protocol.scenario.faults import Fault, failures, scripted
from transport.protocol.scenario.links import Link
from transport.protocol.scenario.schema import ObstacleSection, Scenario, UavSection
from transport.protocol.scenario.targets import ON_GROUND_M, check_scripted, exceeded, least_slowing
from transport.protocol.wire.node import RunShape

Problems = Iterator[tuple[str, str]]  # field of a scenario; expected and got
_WALL_M = 1e5  # width of the walls beside a gap: no path comes near their ends


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSheet:
    """Data sheet of the vehicles' own sensors.

    Position, velocity, attitude, body rates, specific force.
    """

    vehicle: bool  # whether agents have these sensors, not states
    noise: Array  # standard deviations, (5,), SI
    bias: Array  # standard deviations of the constant errors, (5,), SI
    ages: tuple[int, ...]  # sampling periods from a quantity to its measurement


@dataclass(frozen=True)
class Setup:
    """A scenario turned into a system, a maneuver and controller settings."""

    scenario: Scenario
    system: System
    hover: Hover  # at the origin
    maneuver: Maneuver
    settings: ControllerSettings  # the same for every agent
    owned: tuple[tuple[int, ...], ...]  # 0-based UAVs of agent 1, agent 2, ...
    ahead: Ahead | None = field(
        default=None, init=False
    )  # part of the reference that the newest target changes
    # The same run with a further target, by what that is: shared by the nodes of a process.
    _headed: WeakValueDictionary[Hashable, Any] = field(
        default_factory=WeakValueDictionary, init=False, compare=False
    )

    @staticmethod
    def of(scenario: Scenario, source: str) -> "Setup":
        """Return everything a scenario describes.

        Raise ScenarioError, which names the source, if it is impossible.
        """
        section, inner = scenario.system, scenario.controller
        body, gains = (
            section.payload,
            None if inner.inputs == "moments" else 1.0 / np.array(inner.rate_time_constant_s),
        )
        payload = building(
            source, "system.payload", lambda: Payload(mass=body.mass_kg, inertia=body.inertia_kgm2)
        )
        uavs = [building(source, f"system.uav.{uav.id}", partial(_uav, uav)) for uav in section.uav]
        parts: dict[str, Any] = {
            "payload": payload,
            "uavs": uavs,
            "gravity": section.gravity_mps2,
            "rate_gains": gains,
        }
        system = building(source, "system", lambda: System(**parts))
        equilibrium = building(source, "system.uav", lambda: hover(system))
        maneuver = building(source, "maneuver", lambda: _maneuver(scenario))
        # 1/M of M agents: the descent guarantee of cooperative distributed MPC (docs/decisions.md).
        share = 1.0 / len(scenario.owned) if inner.relaxation == "auto" else inner.relaxation
        settings = inner.model_copy(update={"relaxation": share})
        owned = tuple(tuple(uav - 1 for uav in group) for group in scenario.owned)
        setup = Setup(scenario, system, equilibrium, maneuver, settings, owned)
        building(
            source,
            "controller.constraint",
            lambda: compile_constraints(settings.constraint, system),
        )
        building(
            source, "controller.cost", lambda: UserCosts(settings.cost, system).about(equilibrium.x)
        )
        building(
            source, "controller.prediction", lambda: Regulation(setup.model, equilibrium, settings)
        )
        for check in (setup._off_ground, setup._off_hover, setup._off_limits, setup._off_obstacles):
            for key, problem in check():
                raise ScenarioError(source, key, problem)
        building(source, "maneuver.target", lambda: check_scripted(setup))
        return setup

    @cached_property
    def model(self) -> Model:
        """Compiled equations of motion."""
        return Model(self.system)

    @cached_property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Obstacles, in the order of the file."""
        return tuple(_obstacle(section) for section in self.scenario.obstacle)

    @cached_property
    def reference(self) -> Reference | FlatReference:
        """Reference outputs and states."""
        chosen = FlatReference if self.scenario.maneuver.reference == "flat" else Reference
        return chosen(self.system, self.hover, self.maneuver)

    @cached_property
    def track(self) -> Track | None:
        """States and inputs along a flat reference at the instants of `X_ref`.

        None with a hover reference.
        """
        if isinstance(self.reference, Reference):
            return None
        return self.reference.track(len(self._instants_s()), self.settings.sampling_period_s)

    @cached_property
    def Y_ref(self) -> Array:
        """Reference outputs at every instant that any horizon reaches, (K, 4 N + 9)."""
        return self.reference.followed(self._instants_s())[0]

    @cached_property
    def X_ref(self) -> Array:
        """Reference states at the same instants, (K, n)."""
        return self.reference.followed(self._instants_s())[1]

    def headed(self, target: Target, key: Hashable) -> Self:
        """Return this run with a target, which `key` distinguishes from others.

        The reference before it is the same.
        """
        leads = "X_ref" in self.__dict__  # where controllers are
        known: Self | None = self._headed.get((key, leads))
        if known is None:
            known = self._headed[key, leads] = replace(self, maneuver=self.maneuver.headed(target))
            known.__dict__["model"] = (
                self.model
            )  # compiled once; what controllers share is found by it
            if leads:
                known._lead(self, target)
        return known

    def _lead(self, before: "Setup", target: Target) -> None:
        """Compute the reference from that before a target: only from there on until it is at rest."""
        period_s, instants_s = self.settings.sampling_period_s, self._instants_s()
        first = round(target.since_s / period_s)
        until = min(math.ceil(target.ends_s / period_s) + 2, len(instants_s))
        new, Y, X = (
            self.reference.followed(instants_s[first:until]),
            before.Y_ref.copy(),
            before.X_ref.copy(),
        )
        for whole, part in zip((Y, X), new, strict=True):
            whole[first:until], whole[until:] = part, part[-1]
            frozen(whole)
        track = None
        if isinstance(self.reference, FlatReference):
            track = self.reference.track(until - first, period_s, first)
        joined = (
            track if track is None or before.track is None else continued(before.track, track, KEPT)
        )
        ahead = Ahead(first=first, X_ref=new[1], track=track)
        self.__dict__.update(Y_ref=Y, X_ref=X, track=joined, ahead=ahead)

    @property
    def fail_safe(self) -> FailSafe:
        """Control law of the UAVs whose plans have run out."""
        follows = self.settings.fail_safe == "follow"
        return FailSafe(self.system, self.hover.u, self.X_ref if follows else None, self.track)

    def _instants_s(self) -> Array:
        instants = np.arange(self.ticks + self.settings.horizon + 2, dtype=np.float64)
        return self.settings.sampling_period_s * instants

    @cached_property
    def sensors(self) -> SensorSheet:
        """Data sheet of the vehicles' own sensors, which the filters of the agents know."""
        noise, period_s = self.scenario.plant.noise, self.settings.sampling_period_s
        return SensorSheet(
            vehicle=self.scenario.plant.sensors == "vehicle",
            noise=np.array([getattr(noise, key) for key in type(noise.bias).model_fields]),
            bias=np.array(list(noise.bias.model_dump().values())),
            ages=tuple(round(delay_s / period_s) for delay_s in noise.delay.model_dump().values()),
        )

    @property
    def agents(self) -> tuple[int, ...]:
        """Agent ids, 1-based."""
        return tuple(range(1, len(self.owned) + 1))

    @property
    def ticks(self) -> int:
        """Sampling instants of the run: t_k < duration of the maneuver."""
        return ticks_of(self.scenario)

    @property
    def period_ns(self) -> int:
        """Return the sampling period, ns."""
        return round(self.settings.sampling_period_s * 1e9)

    @cached_property
    def shape(self) -> RunShape:
        """What the messages of the run must fit."""
        clock, settings, agents = (
            self.scenario.clock,
            self.settings,
            dict(enumerate(self.owned, start=1)),
        )
        return RunShape(
            owned={agent: tuple(uav + 1 for uav in owned) for agent, owned in agents.items()},
            limits={
                agent: (settings.lower(len(o)), settings.upper(len(o)))
                for agent, o in agents.items()
            },
            uavs=self.system.N,
            ticks=self.ticks,
            delay=1 if clock.next_tick else 0,
            negotiation_iterations=self.scenario.controller.negotiation_iterations,
            vehicle_sensors=self.sensors.vehicle,
            relayed=clock.mode
            == "lockstep",  # the coordinator, which waits for all plans, hands them on
        )

    def link(self, sender: str, receiver: str) -> Link:
        """Return the link that carries one process's messages to another.

        Plans, or measurements from the plant.
        """
        period_s = self.settings.sampling_period_s
        return Link(
            self.scenario.links, sender, receiver, seed=self.scenario.seed, period_s=period_s
        )

    @cached_property
    def faults(self) -> tuple[Fault, ...]:
        """Scripted faults, in the order of time."""
        return scripted(self.scenario)

    def initial_state(self) -> np.ndarray:
        """Return the state of hover at the start of the maneuver, at rest, (12 + 12 N,)."""
        x = self.hover.x.copy()
        x[:3] += self.maneuver.start_I
        return x

    def _off_ground(self) -> Problems:
        """Yield take-offs that do not begin, landings that do not end on the ground, and phases that end below it."""
        ground_m = self.scenario.plant.ground_m
        if ground_m is None:
            return  # without take-offs and landings: protocol.scenario.relations
        resting_m = resting_height(self.system, ground_m)
        at = f"z = {resting_m:g} m, where the payload stands on the ground"
        height_m = float(self.maneuver.start_I[2])
        if height_m > resting_m + ON_GROUND_M:
            yield "maneuver.start_m", f"expected a start above {at}, got {height_m:g}"
        for number, phase in enumerate(self.maneuver.phases, start=1):
            before_m, height_m = height_m, height_m + float(phase.displacement_I[2])
            ends = {"take_off": ("a take-off from", before_m), "land": ("a landing at", height_m)}
            what, got_m = ends.get(phase.kind, ("", resting_m))
            if abs(got_m - resting_m) > ON_GROUND_M:
                yield f"maneuver.phase.{number}", f"expected {what} {at}, got {got_m:g}"
            elif height_m > resting_m + ON_GROUND_M:
                yield f"maneuver.phase.{number}", f"expected a path above {at}, got {height_m:g}"

    def _off_limits(self) -> Problems:
        """Yield how a flat reference exceeds the limits, and the least slowing with which it does not."""
        if self.scenario.maneuver.reference == "hover":
            return
        releases = [
            (fault.tick, fault.uav) for fault in failures(self.faults) if fault.do == "release"
        ]
        key = "maneuver.profile"
        try:
            path = self.maneuver.jets(self._instants_s())
            for count in range(len(releases) + 1):
                key, since = (
                    ("faults.event", releases[count - 1][0]) if count else ("maneuver.phase", 0)
                )
                gone = frozenset(uav for _, uav in releases[:count])
                team = (
                    with_released(self.system, gone),
                    failed_hover(self.system, gone, gone) if gone else self.hover,
                )
                if wrong := exceeded(path[:, since:], *team, self.settings, gone):
                    # After slowing, the release may be anywhere on the path.
                    factor = least_slowing(path, *team, self.settings, gone)
                    remedy = (
                        ""
                        if factor is None
                        else f"; feasible if all phases take {factor:.3f} times as long"
                    )
                    yield key, wrong + remedy
        except ParameterError as error:
            yield key, str(error)

    def _off_obstacles(self) -> Problems:
        """Yield the obstacle whose margins the reference does not keep at the sampling instants."""
        if blocked := self.blocked(self._instants_s()):
            remedy = "slowing does not help: move the path or the obstacle, or lean the rods (maneuver.phase.formation)"
            yield f"obstacle.{blocked[0]}", f"{blocked[1]}; {remedy}"

    def blocked(self, times_s: Array) -> tuple[int, str] | None:
        """Return the first obstacle whose margins the reference does not keep, from 1, and got and expected."""
        for number, obstacle in enumerate(self.obstacles, start=1):
            clear_m = clearances(self.system, obstacle, self.reference.states(times_s))
            margins_m = obstacle.margins(self.system.N)
            row, body = np.unravel_index(np.argmin(clear_m - margins_m), clear_m.shape)
            if clear_m[row, body] < margins_m[body]:
                between = (
                    f"{bodies(self.system.N)[body]} and the {obstacle.name} along the reference"
                )
                got = f"{max(float(clear_m[row, body]), 0.0):.3g} m at {times_s[row]:g} s"
                return number, f"expected {margins_m[body]:g} m between {between}, got {got}"
        return None

    def _off_hover(self) -> Problems:
        """Yield limits on thrust, tension or the distance of UAVs that hover exceeds."""
        settings, rotors = self.settings, self.scenario.plant.motors.rotors
        for uav, thrust_N in enumerate(self.hover.u[::4], start=1):
            for key, what, section, share in (
                ("controller.limits.thrust_N", "the hover thrust", settings.limits, 1.0),
                ("plant.motors.rotors.thrust_N", "a quarter of the hover thrust", rotors, 0.25),
            ):
                if section and not section.thrust_N[0] <= share * thrust_N <= section.thrust_N[1]:
                    expected = f"expected a range that contains {what} {share * thrust_N:.2f} N of UAV{uav}"
                    yield key, f"{expected}, got {list(section.thrust_N)}"
        tension, least_N = settings.tension, float(self.hover.tensions.min())
        if tension is not None and least_N <= tension.minimum_N:
            yield (
                "controller.tension.minimum_N",
                f"expected less than {least_N:.2f} N (hover), got {tension.minimum_N}",
            )
        if settings.separation is not None:
            r = self.model.outputs(self.hover.x)[: 3 * self.system.N].reshape(-1, 3)
            least_m = min(
                (float(np.linalg.norm(a - b)) for a, b in combinations(r, 2)), default=math.inf
            )
            if least_m < settings.separation.minimum_m:
                problem = (
                    f"expected at most {least_m:.3f} m (hover), got {settings.separation.minimum_m}"
                )
                yield "controller.separation.minimum_m", problem


def _uav(section: UavSection) -> Uav:
    return Uav(
        mass=section.mass_kg,
        inertia=section.inertia_kgm2,
        rho=section.rho_m,
        rod_length=section.rod_length_m,
    )


def _maneuver(scenario: Scenario) -> Maneuver:
    section, phases = scenario.maneuver, []
    for p in section.phase:
        curve, way = p.curve(), p.way
        if curve is None and way is not None and section.profile == "smooth":
            curve, way = Curve(kind=None, duration_s=p.duration_s, ramp_s=0.0, table=way), None
        same = {key: getattr(p, key) for key in ("name", "duration_s", "kind", "formation")}
        phases.append(Phase(displacement_I=p.displacement_m, way=way, curve=curve, **same))
    return Maneuver(
        start_I=section.start_m, phases=phases, profile=section.profile, press_m=section.press_m
    )


def _obstacle(section: ObstacleSection) -> Obstacle:
    heading_rad, half, shifts_m = math.radians(section.heading_deg), np.zeros(3), [0.0]
    if section.kind == "cylinder":
        half[2] = np.inf
    elif section.size_m is not None:
        half = np.array(section.size_m) / 2.0
    elif section.width_m is not None:
        half = np.array([section.thickness_m / 2.0, _WALL_M, np.inf])
        shifts_m = [sign * (section.width_m / 2.0 + _WALL_M) for sign in (-1.0, 1.0)]
    across = np.array([-math.sin(heading_rad), math.cos(heading_rad), 0.0])
    body: dict[str, Any] = {
        "heading_rad": heading_rad,
        "half": half,
        "radius": section.radius_m or 0.0,
    }
    solids = tuple(Solid(centre_I=section.at_m + shift_m * across, **body) for shift_m in shifts_m)
    margins_m = {"margin_m": section.margin_m, "load_margin_m": section.load_margin_m}
    return Obstacle(name=section.kind, solids=solids, penalty=section.penalty, **margins_m)
