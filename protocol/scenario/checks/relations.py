"""Relations between the fields of a scenario, checked once each field is valid by itself."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter

from pydantic import BaseModel

from transport.protocol.scenario.checks.link_and_radio_relations import (
    link_problems,
    radio_problems,
)
from transport.protocol.scenario.checks.maneuver_and_obstacle_relations import (
    obstacle_problems,
    phase_problems,
)
from transport.protocol.scenario.faults.fault_relations import Problems, fault_problems
from transport.protocol.scenario.sections.limits_on_size import ticks_of
from transport.protocol.scenario.sections.lockstep_and_realtime_section import first_tick
from transport.protocol.scenario.sections.plant_sections import MujocoSection
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.sections.schema import Scenario

# Least lag of motors, in sampling periods: the discretisation takes exponentials of its reciprocal.
_LEAST_LAG = 0.01

_ANY = object()  # any value but the default
_DEFAULTS = ("mpc", None)


@dataclass(frozen=True, slots=True)
class Need:
    """A value of one key that needs a value of another key."""

    cause: str
    value: object
    key: str
    needed: object

    def is_there(self, given: object) -> bool:
        """Return whether a value of the cause is the one that needs something."""
        values = given if isinstance(given, list) else [given]
        if self.value is _ANY:
            return any(value not in _DEFAULTS for value in values)
        return self.value in values


_NEEDS = (
    Need("controller.terminal", "riccati", "controller.weights.penalised_input", "deviation"),
    Need("controller.share", "on_change", "controller.prediction", "closed_loop"),
    Need("controller.share", "on_change", "controller.received_plans", "by_age"),
    Need("controller.share", "on_change", "controller.received_states", "predicted"),
    Need("controller.share", "on_change", "controller.negotiation_iterations", 1),
    Need("controller.estimator", "measured", "plant.sensors", "state"),
    Need("controller.estimator", "kalman", "plant.sensors", "vehicle"),
    Need("controller.estimator", "kalman", "controller.prediction", "closed_loop"),
    Need("controller.estimator", "kalman", "controller.received_states", "predicted"),
    Need("controller.estimator", "kalman", "controller.share", "always"),
    Need("agents.controller", _ANY, "controller.share", "always"),
    Need("agents.controller", "alone", "controller.negotiation_iterations", 1),
    Need("controller.tension", _ANY, "controller.motor_lag_s", 0.0),
    Need("clock.mode", "realtime", "controller.negotiation_iterations", 1),
    Need("clock.mode", "realtime", "plant.inner_loop", "model"),
    Need("clock.mode", "realtime", "clock.offsets_s", None),
    # Outside an end of the run leaves each UAV to its autopilot, on its rod.
    Need("plant.kind", "vehicles", "clock.on_agent_loss", "continue"),
    Need("plant.kind", "vehicles", "clock.on_coordinator_loss", "continue"),
    Need("plant.inner_loop", "betaflight", "plant.autopilot", None),
    Need("plant.engine", "rods", "plant.ground_m", None),
    Need("plant.engine", "rods", "plant.mujoco", MujocoSection()),
    Need("plant.inner_loop", "betaflight", "controller.inputs", "rates"),
    Need("maneuver.reference", "flat", "controller.prediction", "closed_loop"),
    Need("maneuver.reference", "flat", "controller.linearisation", "along"),
    Need("maneuver.reference", "flat", "controller.terminal", "riccati"),
    Need("maneuver.reference", "flat", "controller.preview", True),
    Need("maneuver.reference", "flat", "controller.motor_lag_s", 0.0),
    Need("maneuver.reference", "flat", "controller.constraint", ()),
)


def check_relations(scenario: Scenario, source: str) -> None:
    """Check the fields of a scenario against each other.

    Raises: ScenarioError: with the first problem.
    """
    checks = (
        _needs,
        _ownership,
        link_problems,
        radio_problems,
        _controller,
        _clock,
        fault_problems,
        _plant,
        _vehicles,
        phase_problems,
        obstacle_problems,
    )
    for check in checks:
        for field, expected, got in check(scenario):
            raise ScenarioError(source, field, f"expected {expected}, got {got}")


def _needs(scenario: Scenario) -> Problems:
    """Yield keys whose value does not go with that of another key."""
    for need in _NEEDS:
        given = attrgetter(need.cause)(scenario)
        got = attrgetter(need.key)(scenario)
        if need.is_there(given) and got != need.needed:
            is_value = isinstance(need.needed, str | int | float)
            expected = repr(need.needed) if is_value else "no value"
            cause = (
                f"[{need.cause}]"
                if isinstance(given, BaseModel)
                else f"{need.cause} = {given!r:.60}"
            )
            yield need.key, f"{expected} with {cause}", f"{got!r:.60}"


def _ownership(scenario: Scenario) -> Problems:
    """Yield wrong ids of UAVs, and UAVs without or with several owners."""
    ids = [uav.id for uav in scenario.system.uav]
    if ids != list(range(1, len(ids) + 1)):
        yield "system.uav.id", f"1, 2, ... {len(ids)} in order", ids

    owned = sorted(uav for group in scenario.owned for uav in group)
    if owned != ids:
        yield "agents.owned", f"each UAV of {ids} once", owned

    agents, controllers = len(scenario.owned), len(scenario.controllers)
    if controllers != agents:
        expected = f"one for each of {agents} agents, or one name for all"
        yield "agents.controller", expected, f"a list of {controllers}"


def _controller(scenario: Scenario) -> Problems:
    """Yield a preview without a control law, and lags that no model of motors can have."""
    section = scenario.controller
    is_without_law = section.prediction == "open_loop" and section.terminal == "multiple"
    if section.preview and is_without_law:
        remedies = "controller.prediction = 'closed_loop' or controller.terminal = 'riccati'"
        yield "controller.preview", f"{remedies} with it", "neither"

    least_s = _LEAST_LAG * section.sampling_period_s
    for key in ("controller.motor_lag_s", "plant.motors.lag_s", "plant.motors.falling_lag_s"):
        lag_s = attrgetter(key)(scenario) or 0.0
        if 0.0 < lag_s < least_s:
            expected = f"0 or at least a hundredth of the sampling period, {least_s:g}"
            yield key, expected, lag_s

    motors = scenario.plant.motors
    if motors.falling_lag_s is not None and (motors.rotors is None or not motors.lag_s):
        rotors = "no rotors" if motors.rotors is None else "rotors"
        got = f"lag_s {motors.lag_s:g}, {rotors}"
        yield "plant.motors.falling_lag_s", "lag_s > 0 and rotors with it", got


def _clock(scenario: Scenario) -> Problems:
    """Yield keys of lockstep in real time, and clocks that differ too much."""
    clock = scenario.clock
    if clock.offsets_s is not None:
        yield from _offsets(scenario, clock.offsets_s)
    if clock.mode != "realtime":
        return
    if clock.speed == 0.0:
        yield "clock.speed", "a number > 0 with mode realtime, such as 1", 0
    if clock.actuation == "immediate":
        expected = "'next_tick' with mode realtime, where a step takes time"
        yield "clock.actuation", expected, "'immediate'"


def _offsets(scenario: Scenario, offsets_s: Sequence[float]) -> Problems:
    """Yield another number of clocks than agents, and clocks that are a sampling period apart."""
    agents = len(scenario.owned)
    if len(offsets_s) != agents:
        yield "clock.offsets_s", f"one for each of {agents} agents", len(offsets_s)
    period_s = scenario.controller.sampling_period_s
    apart_s = max([0.0, *offsets_s]) - min([0.0, *offsets_s])
    if apart_s >= period_s:
        expected = (
            f"clocks less than a sampling period ({period_s:g} s) from the plant's and each other"
        )
        yield "clock.offsets_s", expected, f"{apart_s:g} s"


def _plant(scenario: Scenario) -> Problems:
    """Yield cables that release, and factors of UAVs that the team has not, or has twice."""
    plant = scenario.plant
    is_released = any(event.do == "release" for event in scenario.faults.event)
    if plant.mujoco.suspension == "cables" and is_released:
        yield "plant.mujoco.suspension", "'rods' with a fault 'release'", "'cables'"

    known_ids = [uav.id for uav in scenario.system.uav]
    for number, one in enumerate(plant.uav):
        if one.id not in known_ids or one.id in [before.id for before in plant.uav[:number]]:
            yield f"plant.uav.{number + 1}.id", f"each at most once of {known_ids}", one.id
    yield from _unknown_drag(scenario)


def _unknown_drag(scenario: Scenario) -> Problems:
    """Yield unknown drag beside known drag, and drag that would reverse the motion it brakes."""
    plant = scenario.plant

    # Unknown drag is held over a period: dv = -(c / m) T_s v must not exceed v.
    wind = plant.wind
    section = scenario.system
    period_s = scenario.controller.sampling_period_s
    factors = {one.id: one.mass_factor for one in plant.uav}
    masses_kg = [factors.get(uav.id, 1.0) * uav.mass_kg for uav in section.uav]
    uav_kg = plant.uav_mass_factor * min(masses_kg)
    payload_kg = plant.payload_mass_factor * section.payload.mass_kg
    known = any([section.payload.drag_kgps, *(sum(uav.drag_kgps) for uav in section.uav)])
    for key, drag_kgps, mass_kg in (
        ("drag_payload_kgps", wind.drag_payload_kgps, payload_kg),
        ("drag_uav_kgps", wind.drag_uav_kgps, uav_kg),
    ):
        if drag_kgps is None:
            continue
        if known:
            remedy = "plant.drag_factor and controller.knows_drag change it"
            expected = f"no value with drag_kgps of payload or UAVs in [system]; {remedy}"
            yield f"plant.wind.{key}", expected, drag_kgps
        if drag_kgps * period_s > mass_kg:
            expected = f"at most mass over sampling period {mass_kg / period_s:g}"
            yield f"plant.wind.{key}", expected, drag_kgps


def _vehicles(scenario: Scenario) -> Problems:
    """Yield what a run whose UAVs have processes of their own cannot have."""
    if not scenario.has_vehicles:
        if scenario.clock.on_coordinator_loss == "continue":
            # Only vehicles tick by themselves; a plant that measures waits for the coordinator.
            expected = "'end' without plant.kind = 'vehicles' or plant.autopilot"
            yield "clock.on_coordinator_loss", expected, "'continue'"
        return
    cause = "plant.kind = 'vehicles' or plant.autopilot"
    for key, needed in (
        ("clock.mode", "realtime"),
        ("clock.on_overrun", "continue"),
        ("plant.sensors", "vehicle"),
        ("controller.inputs", "rates"),
        ("controller.fail_safe", "follow"),
    ):
        got = attrgetter(key)(scenario)
        if got != needed:
            yield key, f"{needed!r} with {cause}", f"{got!r:.60}"
    if scenario.controller.silence == "stop":
        yield "controller.silence", f"'alone' or 'law' with {cause}", "'stop'"
    if any(len(group) > 1 for group in scenario.owned):
        yield (
            "agents.owned",
            f"one UAV for each agent with {cause}",
            list(map(list, scenario.owned)),
        )
    if [group[0] for group in scenario.owned] != list(range(1, len(scenario.owned) + 1)):
        yield "agents.owned", f"UAV i for agent i with {cause}", list(map(list, scenario.owned))


def after_the_end(scenario: Scenario) -> Iterator[str]:
    """Yield, in words, the scripted events that come after the last tick of the run: none happens."""
    ticks = ticks_of(scenario)
    period_s = scenario.controller.sampling_period_s
    end_s = math.fsum(phase.duration_s for phase in scenario.maneuver.phase)
    links = scenario.links
    times_s = {
        **{f"faults.event.{i}.at_s": one.at_s for i, one in enumerate(scenario.faults.event, 1)},
        **{f"links.change.{i}.at_s": one.at_s for i, one in enumerate(links.change, 1)},
        **{f"links.partition.{i}.start_s": one.start_s for i, one in enumerate(links.partition, 1)},
    }
    for field, at_s in times_s.items():
        # It acts from the first tick not before it on.
        if first_tick(at_s, period_s) < ticks:
            continue
        last_s = (ticks - 1) * period_s
        when = f"is after the last tick, {last_s:g} s, of the run of {end_s:g} s"
        yield f"{field}: {at_s:g} s {when}, so it does not happen"
