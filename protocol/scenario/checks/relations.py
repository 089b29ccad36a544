"""Relations between the fields of a scenario, checked once each field is valid by itself."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter

from pydantic import BaseModel

from transport.protocol.radio.standards_80211 import STANDARDS
from transport.protocol.scenario.faults.fault_relations import (
    Problems,
    fault_problems,
    processes_of,
)
from transport.protocol.scenario.sections.lockstep_and_realtime_section import first_tick
from transport.protocol.scenario.sections.maneuver_sections import PhaseSection
from transport.protocol.scenario.sections.plant_sections import MujocoSection
from transport.protocol.scenario.sections.run_size import ticks_of
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.wire.names import PLANT

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
        _links,
        _radio,
        _controller,
        _clock,
        fault_problems,
        _plant,
        _vehicles,
        _phases,
        _obstacles,
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


def _links(scenario: Scenario) -> Problems:
    """Yield empty partitions, and ends of links that are no processes of the run."""
    names = processes_of(scenario)
    agents = set(names) - {PLANT}
    for i, partition in enumerate(scenario.links.partition, start=1):
        if partition.end_s <= partition.start_s:
            expected = f"more than start_s {partition.start_s}"
            yield f"links.partition.{i}.end_s", expected, partition.end_s
        # The group is cut off from the agents that it lacks; all of them from none.
        if len(agents) > 1 and agents <= set(partition.between):
            expected = "some of the agents (no message at all: links.change with loss = 1.0)"
            yield f"links.partition.{i}.between", expected, "all of them"

    for field, name in _link_ends(scenario):
        if name is not None and name not in names:
            yield field, f"one of {', '.join(names)}", repr(name)


def _radio(scenario: Scenario) -> Problems:
    """Yield what a radio needs: lockstep, several agents, a rate of its standard, time to compute."""
    radio = scenario.radio
    controller = scenario.controller
    if radio is None:
        return
    if scenario.clock.mode == "realtime":
        yield "radio", "no such section with clock.mode = 'realtime': the network is real", "one"
    if len(scenario.owned) == 1:
        yield "radio", "several agents with it: one agent sends no plans", "one agent"

    rates_mbps = STANDARDS[radio.standard].rates_mbps
    if radio.rate_mbps not in rates_mbps:
        shown = ", ".join(f"{rate:g}" for rate in rates_mbps)
        yield "radio.rate_mbps", f"one of {shown} with {radio.standard}", f"{radio.rate_mbps:g}"

    if radio.inputs == "first" and controller.prediction != "closed_loop":
        expected = (
            "'all' without controller.prediction = 'closed_loop': the others predict with them"
        )
        yield "radio.inputs", expected, "'first'"
    if radio.inputs == "first" and set(scenario.controllers) != {"mpc"}:
        yield "radio.inputs", "'all' with a controller that is not 'mpc'", "'first'"

    exchange_s = controller.sampling_period_s / controller.negotiation_iterations
    computed_s = radio.computation_mean_s + 3.0 * radio.computation_deviation_s
    if radio.offsets == "slots" and computed_s >= exchange_s:
        expected = f"mean and three deviations below {exchange_s:g} s, the time of an exchange"
        yield "radio.computation_mean_s", f"{expected}, with offsets 'slots'", f"{computed_s:g} s"

    if radio.cycle_ticks is not None and radio.offsets != "slots":
        expected = f"no value with radio.offsets = {radio.offsets!r}, which has no slots"
        yield "radio.cycle_ticks", expected, str(radio.cycle_ticks)
    if (radio.cycle_ticks or 1) > 1 and controller.negotiation_iterations > 1:
        iterations = f"controller.negotiation_iterations = {controller.negotiation_iterations}"
        expected = f"1 with {iterations}: each exchange has the slots of all agents"
        yield "radio.cycle_ticks", expected, str(radio.cycle_ticks)


def _link_ends(scenario: Scenario) -> Iterator[tuple[str, str | None]]:
    """Yield the fields that name an end of a link, and the names."""
    links = scenario.links
    for key, sections in (("override", links.override), ("change", links.change)):
        for i, section in enumerate(sections, start=1):
            yield f"links.{key}.{i}.from", section.from_
            yield f"links.{key}.{i}.to", section.to
    for i, partition in enumerate(links.partition, start=1):
        for name in partition.between:
            yield f"links.partition.{i}.between", name


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
        ("radio", None),
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


def _phases(scenario: Scenario) -> Problems:
    """Yield phases whose fields contradict each other, or the rest of the maneuver."""
    maneuver = scenario.maneuver
    for i, phase in enumerate(maneuver.phase, start=1):
        field = f"maneuver.phase.{i}"
        if phase.kind in ("take_off", "land"):
            yield from _vertical(phase, field, has_ground=scenario.plant.ground_m is not None)
        yield from _curve(phase, field)

        if phase.formation and maneuver.reference == "hover":
            yield f"{field}.formation", "maneuver.reference = 'flat' with it", "'hover'"
        is_last = not any(later.formation for later in maneuver.phase[i:])
        if phase.formation and is_last and phase.formation[-1][1:] != (1.0, 1.0):
            got = list(phase.formation[-1][1:])
            yield f"{field}.formation", "1, 1 at the end of the maneuver", got


def _vertical(phase: PhaseSection, field: str, *, has_ground: bool) -> Problems:
    """Yield what is wrong with a take-off or landing."""
    if not has_ground:
        yield f"{field}.kind", "plant.ground_m with it", f"{phase.kind!r} without a ground"

    x, y, z = phase.displacement_m
    is_take_off = phase.kind == "take_off"
    is_right_way = z < 0.0 if is_take_off else z > 0.0
    if x != 0.0 or y != 0.0 or not is_right_way:
        direction = "up, negative z" if is_take_off else "down, positive z"
        yield f"{field}.displacement_m", f"a path straight {direction}", [x, y, z]


def _curve(phase: PhaseSection, field: str) -> Problems:
    """Yield what is wrong with the table, the way points or the ramps of a phase."""
    if phase.kind != "move" and phase.way is not None:
        yield f"{field}.kind", "'move' with a path from a file", repr(phase.kind)

    points = phase.points_m or []
    if phase.kind == "spline" and not points:
        yield f"{field}.points_m", "way points with kind 'spline'", "none"
    if phase.kind != "spline":
        for key in ("points_m", "times_s"):
            if getattr(phase, key) is not None:
                yield f"{field}.{key}", "it only with kind 'spline'", f"kind {phase.kind!r}"

    times = phase.times_s
    if times is not None:
        is_rising = all(earlier < later for earlier, later in pairwise(times))
        if len(times) != len(points) or not is_rising:
            expected = f"{len(points)} rising times, one for each way point"
            yield f"{field}.times_s", expected, times

    longest_s = phase.duration_s / 2.0
    if phase.curve() is not None and phase.ramp_s > longest_s:
        yield f"{field}.ramp_s", f"at most half the duration, {longest_s:g} s", phase.ramp_s


def _obstacles(scenario: Scenario) -> Problems:
    """Yield sizes that an obstacle of its kind lacks or does not have."""
    sizes = {"radius_m": ("sphere", "cylinder"), "size_m": ("box",), "width_m": ("gap",)}
    for i, section in enumerate(scenario.obstacle, start=1):
        for key, kinds in sizes.items():
            given = getattr(section, key)
            is_missing = given is None
            if is_missing == (section.kind in kinds):
                article = "a" if is_missing else "no such"
                expected = f"{article} size with kind {section.kind!r}"
                yield f"obstacle.{i}.{key}", expected, given or "nothing"
        if section.seen_within_m is not None:
            if section.seen_within_m <= section.margin_m:
                expected = f"more than its margin_m, {section.margin_m:g}"
                yield f"obstacle.{i}.seen_within_m", expected, section.seen_within_m
            if scenario.has_vehicles:
                expected = "no value where UAVs have processes of their own, which see nothing"
                yield f"obstacle.{i}.seen_within_m", expected, section.seen_within_m
