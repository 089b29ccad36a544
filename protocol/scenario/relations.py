"""Relations between the fields of a scenario, checked once each field is valid by itself."""

from collections.abc import Iterator
from itertools import pairwise
from operator import attrgetter

from transport.protocol.scenario.errors import ScenarioError
from transport.protocol.scenario.faults import OF_UAVS
from transport.protocol.scenario.plant_sections import MujocoSection
from transport.protocol.scenario.schema import Scenario
from transport.protocol.wire.names import COORDINATOR, PLANT, agent_name

_SHORTEST_LAG = (
    0.01  # of motors, sampling periods: the discretisation takes exponentials of its reciprocal
)

_OTHER = object()  # any value but the default
# Key and value, then a key and the value that they need.
_NEEDS = (
    ("controller.terminal", "riccati", "controller.weights.penalised_input", "deviation"),
    ("controller.share", "on_change", "controller.prediction", "closed_loop"),
    ("controller.share", "on_change", "controller.received_plans", "by_age"),
    ("controller.share", "on_change", "controller.received_states", "predicted"),
    ("controller.share", "on_change", "controller.negotiation_iterations", 1),
    ("controller.estimator", "measured", "plant.sensors", "state"),
    ("controller.estimator", "kalman", "plant.sensors", "vehicle"),
    ("controller.estimator", "kalman", "controller.prediction", "closed_loop"),
    ("controller.estimator", "kalman", "controller.received_states", "predicted"),
    ("controller.estimator", "kalman", "controller.share", "always"),
    ("agents.controller", _OTHER, "controller.share", "always"),
    ("controller.tension", _OTHER, "controller.motor_lag_s", 0.0),
    ("clock.mode", "realtime", "controller.negotiation_iterations", 1),
    ("clock.mode", "realtime", "plant.inner_loop", "model"),
    ("plant.engine", "rods", "plant.ground_m", None),
    ("plant.engine", "rods", "plant.mujoco", MujocoSection()),
    ("plant.inner_loop", "betaflight", "controller.inputs", "rates"),
    ("maneuver.reference", "flat", "controller.prediction", "closed_loop"),
    ("maneuver.reference", "flat", "controller.linearisation", "along"),
    ("maneuver.reference", "flat", "controller.terminal", "riccati"),
    ("maneuver.reference", "flat", "controller.preview", True),
    ("maneuver.reference", "flat", "controller.motor_lag_s", 0.0),
    ("maneuver.reference", "flat", "controller.constraint", ()),
)

Problems = Iterator[tuple[str, str, object]]  # field, what was expected there, and what came


def check_relations(scenario: Scenario, source: str) -> None:
    """Check the fields of a scenario against each other.

    Raises: ScenarioError: with the first problem.
    """
    for check in (
        _needs,
        _ownership,
        _links,
        _controller,
        _clock,
        _faults,
        _plant,
        _phases,
        _obstacles,
    ):
        for field, expected, got in check(scenario):
            raise ScenarioError(source, field, f"expected {expected}, got {got}")


def _needs(scenario: Scenario) -> Problems:
    for cause, value, key, needed in _NEEDS:
        given, got = attrgetter(cause)(scenario), attrgetter(key)(scenario)
        if (given == value or (value is _OTHER and given not in ("mpc", None))) and got != needed:
            expected = repr(needed) if isinstance(needed, str | int | float) else "no value"
            yield key, f"{expected} with {cause} = {given!r:.60}", f"{got!r:.60}"


def _ownership(scenario: Scenario) -> Problems:
    ids = [uav.id for uav in scenario.system.uav]
    if ids != list(range(1, len(ids) + 1)):
        yield "system.uav.id", f"1, 2, ... {len(ids)} in order", ids
    owned = sorted(uav for group in scenario.owned for uav in group)
    if owned != ids:
        yield "agents.owned", f"each UAV of {ids} once", owned


def _links(scenario: Scenario) -> Problems:
    links, names = scenario.links, _processes(scenario)
    ends: list[tuple[str, str | None]] = []
    for key, sections in (("override", links.override), ("change", links.change)):
        for i, section in enumerate(sections, start=1):
            ends += [(f"links.{key}.{i}.from", section.from_), (f"links.{key}.{i}.to", section.to)]
    for i, partition in enumerate(links.partition, start=1):
        ends += [(f"links.partition.{i}.between", name) for name in partition.between]
        if partition.end_s <= partition.start_s:
            yield (
                f"links.partition.{i}.end_s",
                f"more than start_s {partition.start_s}",
                partition.end_s,
            )
    for field, name in ends:
        if name is not None and name not in names:
            yield field, f"one of {', '.join(names)}", repr(name)


def _processes(scenario: Scenario) -> list[str]:
    return [PLANT, *(agent_name(agent) for agent in range(1, len(scenario.owned) + 1))]


def _controller(scenario: Scenario) -> Problems:
    section, motors = scenario.controller, scenario.plant.motors
    if section.preview and section.prediction == "open_loop" and section.terminal == "multiple":
        expected = (
            "controller.prediction = 'closed_loop' or controller.terminal = 'riccati' with it"
        )
        yield "controller.preview", expected, "neither"
    shortest_s = _SHORTEST_LAG * section.sampling_period_s
    for key in ("controller.motor_lag_s", "plant.motors.lag_s", "plant.motors.falling_lag_s"):
        if 0.0 < (lag_s := attrgetter(key)(scenario) or 0.0) < shortest_s:
            yield key, f"0 or at least a hundredth of the sampling period, {shortest_s:g}", lag_s
    if motors.falling_lag_s is not None and (motors.rotors is None or not motors.lag_s):
        got = f"lag_s {motors.lag_s:g}, {'no ' if motors.rotors is None else ''}rotors"
        yield "plant.motors.falling_lag_s", "lag_s > 0 and rotors with it", got


def _clock(scenario: Scenario) -> Problems:
    if scenario.clock.mode == "realtime" and scenario.clock.speed == 0.0:
        yield "clock.speed", "a number > 0 with mode realtime, such as 1", 0
    if scenario.clock.mode == "realtime" and scenario.clock.actuation == "immediate":
        yield (
            "clock.actuation",
            "'next_tick' with mode realtime, where a step takes time",
            "'immediate'",
        )


def _faults(scenario: Scenario) -> Problems:
    processes, uavs = (
        [COORDINATOR, *_processes(scenario)],
        [f"uav{section.id}" for section in scenario.system.uav],
    )
    last: dict[str, str] = {}  # action on each target
    for i, event in sorted(
        enumerate(scenario.faults.event, start=1), key=lambda entry: entry[1].at_s
    ):
        field, do, target = f"faults.event.{i}", event.do, event.target
        possible = uavs if do in OF_UAVS else processes[2:] if do == "restart" else processes
        if target not in possible:
            yield f"{field}.target", f"one of {', '.join(possible)}", repr(target)
        if (do == "degrade") != (event.efficiency is not None):
            expected = "an efficiency" if do == "degrade" else "no efficiency without 'degrade'"
            yield f"{field}.efficiency", expected, event.efficiency or "nothing"
        if do == "motor_off" and scenario.maneuver.reference == "flat":
            yield f"{field}.do", "'release' with maneuver.reference = 'flat'", "'motor_off'"
        before = last.get(target, "start")
        if before == "release" or (do == "continue" and before != "stop"):
            yield f"{field}.do", f"an action possible for {target} after its {before}", repr(do)
        last[target] = do
    of_motors = {
        event.target for event in scenario.faults.event if event.do in ("motor_off", "release")
    }
    grounded = scenario.plant.ground_m is not None and all(
        last.get(uav) == "release" for uav in uavs
    )
    if not grounded and of_motors.issuperset(uavs):
        yield (
            "faults.event",
            "at least one UAV that keeps its motors",
            f"motor_off or release for all {len(uavs)}",
        )


def _plant(scenario: Scenario) -> Problems:
    plant, period_s = scenario.plant, scenario.controller.sampling_period_s
    if plant.mujoco.suspension == "cables" and any(
        event.do == "release" for event in scenario.faults.event
    ):
        yield "plant.mujoco.suspension", "'rods' with a fault 'release'", "'cables'"
    # Drag is held over a period, so above this bound it would reverse the motion it brakes; only in
    # wind.
    wind, system = plant.wind, scenario.system
    lightest_kg = plant.uav_mass_factor * min(uav.mass_kg for uav in system.uav)
    payload_kg = plant.payload_mass_factor * system.payload.mass_kg
    for key, mass in (("drag_payload_kgps", payload_kg), ("drag_uav_kgps", lightest_kg)):
        if getattr(wind, key) * period_s > mass and any([*wind.speed_mps, *wind.gust_mps]):
            yield (
                f"plant.wind.{key}",
                f"at most mass over sampling period {mass / period_s:g}",
                getattr(wind, key),
            )


def _phases(scenario: Scenario) -> Problems:
    maneuver = scenario.maneuver
    for i, phase in enumerate(maneuver.phase, start=1):
        field, times, points = f"maneuver.phase.{i}", phase.times_s, phase.points_m or []
        x, y, z = phase.displacement_m
        if phase.kind in ("take_off", "land"):
            if scenario.plant.ground_m is None:
                yield f"{field}.kind", "plant.ground_m with it", f"{phase.kind!r} without a ground"
            sign, direction = (
                (-1.0, "up, negative z") if phase.kind == "take_off" else (1.0, "down, positive z")
            )
            if x != 0.0 or y != 0.0 or sign * z <= 0.0:
                yield f"{field}.displacement_m", f"a path straight {direction}", [x, y, z]
        if phase.kind != "move" and phase.way is not None:
            yield f"{field}.kind", "'move' with a path from a file", repr(phase.kind)
        if phase.kind == "spline" and not points:
            yield f"{field}.points_m", "way points with kind 'spline'", "none"
        if times is not None and (
            len(times) != len(points) or any(b <= a for a, b in pairwise(times))
        ):
            yield f"{field}.times_s", f"{len(points)} rising times, one for each way point", times
        if phase.curve() is not None and phase.ramp_s > phase.duration_s / 2.0:
            yield (
                f"{field}.ramp_s",
                f"at most half the duration, {phase.duration_s / 2.0:g} s",
                phase.ramp_s,
            )
        if phase.formation and maneuver.reference == "hover":
            yield f"{field}.formation", "maneuver.reference = 'flat' with it", "'hover'"
        is_last = not any(later.formation for later in maneuver.phase[i:])
        if phase.formation and is_last and phase.formation[-1][1:] != (1.0, 1.0):
            yield (
                f"{field}.formation",
                "1, 1 at the end of the maneuver",
                list(phase.formation[-1][1:]),
            )


def _obstacles(scenario: Scenario) -> Problems:
    sizes = {"radius_m": ("sphere", "cylinder"), "size_m": ("box",), "width_m": ("gap",)}
    for i, section in enumerate(scenario.obstacle, start=1):
        for key, kinds in sizes.items():
            given = getattr(section, key)
            if (given is None) == (section.kind in kinds):
                expected = f"{'a' if given is None else 'no such'} size with kind {section.kind!r}"
                yield f"obstacle.{i}.{key}", expected, given or "nothing"
