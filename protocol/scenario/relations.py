"""Relations between the fields of a scenario, checked once each field is valid by itself."""

import re
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from protocol.scenario.budget import estimate
from protocol.scenario.errors import ScenarioError
from protocol.scenario.faults import OF_UAVS
from protocol.scenario.keys import out_of_range
from protocol.scenario.link_sections import LinkChangeSection, LinkOverrideSection
from protocol.scenario.plant_sections import MujocoSection
from protocol.scenario.schema import FURTHEST_M, Scenario
from protocol.wire.codec import MAX_BYTES
from protocol.wire.names import COORDINATOR, PLANT, agent_name

# Contacts of MuJoCo have a time constant of 0.02 s, which takes two steps at least.
LONGEST_MUJOCO_STEP_S = 0.01
# Shortest lag of motors other than none, in sampling periods: the discretisation takes exponentials of its reciprocal.
_SHORTEST_LAG = 0.01

# States in which a fault can happen to its target, and the state it leaves.
_FAULTS = {
    "kill": (("running", "stopped"), "killed"),
    "stop": (("running",), "stopped"),
    "continue": (("stopped",), "running"),
    "restart": (("running", "stopped", "killed"), "running"),
    "motor_off": (("running",), "off"),
    "release": (("running", "off"), "released"),  # the motors of a running one go off with it
    "degrade": (("running",), "running"),
}

# Keys that sharing on change needs, as receivers predict the sender between two of its plans: value and reason.
_SHARING = {
    "prediction": ("closed_loop", "where other agents know the control law between two plans"),
    "received_plans": ("by_age", "as plans are used for longer than a period"),
    "received_states": ("predicted", "as states are used for longer than a period"),
    "negotiation_iterations": (1, "as each iteration exchanges every plan"),
}

# Keys that the Kalman filter needs.
_FILTERING = {
    "prediction": ("closed_loop", "which predicts the others by the shared control law"),
    "received_states": ("predicted", "as messages hold measurements, not states"),
    "share": ("always", "as plans carry the measurements"),
}

# Field, what was expected there, and what came.
Problems = Iterator[tuple[str, str, object]]


def check_relations(scenario: Scenario, source: str) -> None:
    """Check the fields of a scenario against each other.

    Raises: ScenarioError: with the first problem.
    """
    for field, problem in out_of_range(scenario):
        raise ScenarioError(source, field, problem)
    for check in (_ownership, _links, _controller, _clock, _faults, _plant, _curves, _path, _obstacles, _network):
        for field, expected, got in check(scenario):
            raise ScenarioError(source, field, f"expected {expected}, got {got}")
    if scenario.clock.relayed and (size := estimate(scenario).relay_bytes) > MAX_BYTES:
        text = f"expected plans of a tick of at most {MAX_BYTES:,} bytes in one message, got {size:,.0f}"
        text += "; set a shorter horizon"
        raise ScenarioError(source, "controller.horizon", text)


def _processes(scenario: Scenario) -> list[str]:
    return [PLANT, *(agent_name(agent) for agent in range(1, len(scenario.owned) + 1))]


def _ownership(scenario: Scenario) -> Problems:
    ids = [uav.id for uav in scenario.system.uav]
    if ids != list(range(1, len(ids) + 1)):
        yield "system.uav.id", f"1, 2, ... {len(ids)} in order", ids
    owners: dict[int, int] = {}
    for agent, group in enumerate(scenario.owned, start=1):
        for uav in group:
            if uav not in ids:
                yield f"agents.owned.{agent}", f"ids of UAVs 1..{len(ids)}", uav
            if uav in owners:
                yield f"agents.owned.{agent}", "each UAV once", f"UAV{uav}, owned by agent {owners[uav]}"
            owners[uav] = agent
    for uav in ids:
        if uav not in owners:
            yield "agents.owned", "each UAV once", f"none for UAV{uav}"


def _links(scenario: Scenario) -> Problems:
    links, names = scenario.links, _processes(scenario)
    one_of = f"one of {', '.join(names)}"
    for place, section in links.all().items():
        field = f"links.{place}" if place else "links"
        if isinstance(section, LinkOverrideSection):
            for key, name in (("from", section.from_), ("to", section.to)):
                if name is not None and name not in names:
                    yield f"{field}.{key}", one_of, repr(name)
        if section.distribution == "empirical" and section.samples is None:
            yield f"{field}.samples", "a file of measured delays", "nothing"
        changed = isinstance(section, LinkChangeSection) and section.samples is not None
        if changed and section.distribution != "empirical":
            expected = "'empirical' with samples, as a change names every changed key"
            yield f"{field}.distribution", expected, repr(section.distribution)
    for i, partition in enumerate(links.partition, start=1):
        for name in partition.between:
            if name not in names:
                yield f"links.partition.{i}.between", one_of, repr(name)
        if partition.end_s <= partition.start_s:
            yield f"links.partition.{i}.end_s", f"more than start_s {partition.start_s}", partition.end_s


def _controller(scenario: Scenario) -> Problems:
    section = scenario.controller
    if section.terminal == "riccati" and section.weights.penalised_input == "absolute":
        expected = "'deviation' with controller.terminal = 'riccati', whose optimum is hover"
        yield "controller.weights.penalised_input", expected, "'absolute'"
    weights, default = section.weights, type(section.weights)()
    for key, instead in (("thrust", "acceleration"), ("moments", "angular_acceleration")):
        given = getattr(weights, key)
        if getattr(weights, instead) is not None and given != getattr(default, key):
            yield f"controller.weights.{key}", f"no such weight beside controller.weights.{instead}", given
    if section.preview and section.prediction == "open_loop" and section.terminal == "multiple":
        expected = "controller.prediction = 'closed_loop' or controller.terminal = 'riccati' with it"
        yield "controller.preview", expected, "neither"
    if section.share == "on_change":
        for key, (needed, why) in _SHARING.items():
            if (got := getattr(section, key)) != needed:
                yield f"controller.{key}", f"{needed!r} with controller.share 'on_change', {why}", repr(got)
    if scenario.agents.controller != "mpc":
        why = "with a class as agents.controller, which has neither corrections nor proposals"
        for key, needed in (("share", "always"), ("negotiation_iterations", 1)):
            if (got := getattr(section, key)) != needed:
                yield f"controller.{key}", f"{needed!r} {why}", repr(got)
    sensors = scenario.plant.sensors
    if sensors == "vehicle" and scenario.agents.controller != "mpc":
        yield "plant.sensors", "'state' with a class as agents.controller, which gets states", repr(sensors)
    if (section.estimator == "kalman") != (sensors == "vehicle"):
        needed = "vehicle" if section.estimator == "kalman" else "state"
        yield "plant.sensors", f"{needed!r} with controller.estimator {section.estimator!r}", repr(sensors)
    if section.estimator == "kalman":
        for key, (needed, why) in _FILTERING.items():
            if (got := getattr(section, key)) != needed:
                yield f"controller.{key}", f"{needed!r} with controller.estimator 'kalman', {why}", repr(got)
    # A lag is none, or long enough for the exponential of the discretisation.
    shortest_s = _SHORTEST_LAG * section.sampling_period_s
    if section.tension is not None and section.motor_lag_s > 0.0:
        yield "controller.tension", "controller.motor_lag_s = 0 with it", section.motor_lag_s
    motors = scenario.plant.motors
    for key, lag_s in (
        ("controller.motor_lag_s", section.motor_lag_s),
        ("plant.motors.lag_s", motors.lag_s),
        ("plant.motors.falling_lag_s", motors.falling_lag_s or 0.0),
    ):
        if 0.0 < lag_s < shortest_s:
            yield key, f"0 or at least a hundredth of the sampling period, {shortest_s:g}", lag_s
    if motors.falling_lag_s is not None and (motors.rotors is None or not motors.lag_s):
        got = f"lag_s {motors.lag_s:g}, {'no ' if motors.rotors is None else ''}rotors"
        yield "plant.motors.falling_lag_s", "lag_s > 0 and rotors with it", got


def _clock(scenario: Scenario) -> Problems:
    clock, iterations = scenario.clock, scenario.controller.negotiation_iterations
    if clock.mode != "realtime":
        return
    if clock.speed == 0.0:
        yield "clock.speed", "a number > 0 with mode realtime, such as 1", 0
    if clock.actuation == "immediate":
        yield "clock.actuation", "'next_tick' with mode realtime, where a step takes time", "'immediate'"
    if iterations > 1:
        expected = "1 with mode realtime, where agents do not wait for each other"
        yield "controller.negotiation_iterations", expected, iterations


def _faults(scenario: Scenario) -> Problems:
    plant, *agents = _processes(scenario)
    processes, uavs = [COORDINATOR, plant, *agents], [f"uav{section.id}" for section in scenario.system.uav]
    state = dict.fromkeys([*processes, *uavs], "running")
    for i, event in sorted(enumerate(scenario.faults.event, start=1), key=lambda entry: entry[1].at_s):
        field, target = f"faults.event.{i}", event.target
        possible = uavs if event.do in OF_UAVS else processes
        if target not in possible:
            yield f"{field}.target", f"one of {', '.join(possible)}", repr(target)
        if event.do == "restart" and target not in agents:
            yield f"{field}.do", f"an agent to restart, as a run ends with its {target}", "'restart'"
        if (event.do == "degrade") != (event.efficiency is not None):
            expected = "an efficiency" if event.do == "degrade" else "no efficiency without 'degrade'"
            yield f"{field}.efficiency", expected, event.efficiency or "nothing"
        before, after = _FAULTS[event.do]
        if state[target] not in before:
            yield f"{field}.do", f"an action possible for {target}, which is {state[target]} by then", repr(event.do)
        state[target] = after
    grounded = scenario.plant.ground_m is not None and all(state[uav] == "released" for uav in uavs)
    if not grounded and all(state[uav] in ("off", "released") for uav in uavs):
        yield "faults.event", "at least one UAV that keeps its motors", f"motor_off or release for all {len(uavs)}"


def _plant(scenario: Scenario) -> Problems:
    """Steps too long for a period or for contacts, settings without effect, drag that reverses motion."""
    plant, mujoco, period_s = scenario.plant, scenario.plant.mujoco, scenario.controller.sampling_period_s
    if plant.step_s > period_s:
        yield "plant.step_s", f"at most the sampling period {period_s}", plant.step_s
    if plant.engine == "rods":
        expected = "plant.engine = 'mujoco' or an engine of your own with it"
        if plant.ground_m is not None:
            yield "plant.ground_m", expected, "'rods', which has no ground"
        if mujoco != MujocoSection():
            yield "plant.mujoco", expected, "'rods'"
    if plant.inner_loop != "model":
        if scenario.controller.inputs != "rates":
            yield "plant.inner_loop", "controller.inputs = 'rates' with a firmware", repr(scenario.controller.inputs)
        if scenario.clock.mode == "realtime":
            yield (
                "plant.inner_loop",
                "'model' with mode realtime, as a firmware has virtual time",
                repr(plant.inner_loop),
            )
    if mujoco.step_s > min(period_s, LONGEST_MUJOCO_STEP_S):
        expected = f"at most the sampling period {period_s} and {LONGEST_MUJOCO_STEP_S} s, as contacts are stiff"
        yield "plant.mujoco.step_s", expected, mujoco.step_s
    if mujoco.suspension == "cables" and any(event.do == "release" for event in scenario.faults.event):
        yield "plant.mujoco.suspension", "'rods' with a fault 'release'", "'cables'"
    # Drag is held over a period, so above this bound it would reverse the motion it brakes; only in wind.
    wind, system = plant.wind, scenario.system
    lightest_kg = plant.uav_mass_factor * min(uav.mass_kg for uav in system.uav)
    payload_kg = plant.payload_mass_factor * system.payload.mass_kg
    for key, drag, mass in (
        ("drag_payload_kgps", wind.drag_payload_kgps, payload_kg),
        ("drag_uav_kgps", wind.drag_uav_kgps, lightest_kg),
    ):
        if drag * period_s > mass and any([*wind.speed_mps, *wind.gust_mps]):
            yield f"plant.wind.{key}", f"at most mass over sampling period {mass / period_s:g}", drag


def _path(scenario: Scenario) -> Problems:
    """A path stays where float64 resolves positions to well below a millimetre, and where measurements are valid.

    Take-offs and landings are vertical, and need a ground.
    """
    within = f"a path within {FURTHEST_M:g} m of the origin"
    reached = scenario.maneuver.start_m
    if max(map(abs, reached)) > FURTHEST_M:
        yield "maneuver.start_m", within, list(reached)
    for i, phase in enumerate(scenario.maneuver.phase, start=1):
        field, (x, y, z) = f"maneuver.phase.{i}", phase.displacement_m
        places = [place for _, *place in phase.way or [] if len(place) == len(reached)]
        if (curve := phase.curve()) is not None:
            places = curve.path(np.linspace(0.0, phase.duration_s, 101), 1)[0].tolist()
        for way in [*places, phase.displacement_m]:
            furthest = max(abs(a + b) for a, b in zip(reached, way, strict=True))
            if furthest > FURTHEST_M:
                yield f"{field}.{'way' if phase.way else 'displacement_m'}", within, f"{furthest:g} m"
        reached = tuple(a + b for a, b in zip(reached, phase.displacement_m, strict=True))
        if phase.kind not in ("take_off", "land"):
            continue
        if scenario.plant.ground_m is None:
            yield f"{field}.kind", "plant.ground_m with it", f"{phase.kind!r} without a ground"
        if phase.way is not None:
            yield f"{field}.kind", "'move' with a path from a file", repr(phase.kind)
        if x != 0.0 or y != 0.0 or (z >= 0.0 if phase.kind == "take_off" else z <= 0.0):
            direction = "up, negative z" if phase.kind == "take_off" else "down, positive z"
            yield f"{field}.displacement_m", f"a path straight {direction}", list(phase.displacement_m)


def _curves(scenario: Scenario) -> Problems:
    """A spline has way points and rising times; a flat reference needs a shared law along it."""
    for i, phase in enumerate(scenario.maneuver.phase, start=1):
        field, times = f"maneuver.phase.{i}", phase.times_s
        if phase.kind == "spline" and not phase.points_m:
            yield f"{field}.points_m", "way points with kind 'spline'", "none"
        if times is not None and (len(times) != len(phase.points_m or []) or any(b <= a for a, b in pairwise(times))):
            yield f"{field}.times_s", f"{len(phase.points_m or [])} rising times, one for each way point", times
        if phase.curve() is not None and phase.ramp_s > phase.duration_s / 2.0:
            yield f"{field}.ramp_s", f"at most half the duration, {phase.duration_s / 2.0:g} s", phase.ramp_s
        if phase.curve() is not None and phase.way is not None:
            yield f"{field}.kind", "'move' with a path from a file", repr(phase.kind)
    changed = [(i, phase) for i, phase in enumerate(scenario.maneuver.phase, start=1) if phase.formation]
    for i, phase in changed:
        if scenario.maneuver.reference == "hover":
            yield f"maneuver.phase.{i}.formation", "maneuver.reference = 'flat' with it", "'hover'"
        if i == changed[-1][0] and phase.formation[-1][1:] != (1.0, 1.0):  # type: ignore[index]  # not None
            yield f"maneuver.phase.{i}.formation", "1, 1 at the end of the maneuver", list(phase.formation[-1][1:])  # type: ignore[index]
    if scenario.maneuver.reference == "hover":
        return
    section = scenario.controller
    for key, got, needed in (
        ("prediction", section.prediction, "closed_loop"),
        ("linearisation", section.linearisation, "along"),
        ("terminal", section.terminal, "riccati"),
        ("preview", section.preview, True),
        ("motor_lag_s", section.motor_lag_s, 0.0),
    ):
        if got != needed:
            yield f"controller.{key}", f"{needed!r} with maneuver.reference = 'flat'", repr(got)
    for i, event in enumerate(scenario.faults.event, start=1):
        if event.do == "motor_off":
            yield f"faults.event.{i}.do", "'release' with maneuver.reference = 'flat'", "'motor_off'"
    if section.constraint:
        yield "controller.constraint", "none with maneuver.reference = 'flat'", section.constraint[0].expression


def _obstacles(scenario: Scenario) -> Problems:
    """An obstacle has the size of its kind, and no other."""
    sizes = {"radius_m": ("sphere", "cylinder"), "size_m": ("box",), "width_m": ("gap",)}
    for i, section in enumerate(scenario.obstacle, start=1):
        for key, kinds in sizes.items():
            if (getattr(section, key) is None) == (section.kind in kinds):
                expected = "a size" if section.kind in kinds else "no such size"
                yield (
                    f"obstacle.{i}.{key}",
                    f"{expected} with kind {section.kind!r}",
                    getattr(section, key) or "nothing",
                )


def _network(scenario: Scenario) -> Problems:
    router = scenario.network.router
    if router is not None and not re.fullmatch(r"(tcp|tls)/\S+:\d+", router):
        yield "network.router", "an endpoint such as tls/192.0.2.1:7447", repr(router)
