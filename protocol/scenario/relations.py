"""Relations between the fields of a scenario, checked once each field is valid by itself."""

import re
from collections.abc import Iterator

from protocol.scenario.budget import estimate
from protocol.scenario.errors import ScenarioError
from protocol.scenario.faults import OF_UAVS
from protocol.scenario.keys import out_of_range
from protocol.scenario.link_sections import LinkChangeSection, LinkOverrideSection
from protocol.scenario.plant_sections import MujocoSection
from protocol.scenario.schema import Scenario
from protocol.wire.codec import MAX_BYTES
from protocol.wire.names import COORDINATOR, PLANT, agent_name

# Largest distance of a path from the origin along any axis, m.
FURTHEST_M = 1e5

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

# Field, and what was expected there and what came.
Problem = tuple[str, str]


def check_relations(scenario: Scenario, source: str) -> None:
    """Check the fields of a scenario against each other.

    Raises: ScenarioError: with the first problem.
    """
    agents = [agent_name(agent) for agent in range(1, len(scenario.owned) + 1)]
    for problems in (
        out_of_range(scenario),
        _ownership(scenario),
        _links(scenario, agents),
        _controller(scenario),
        _clock(scenario),
        _faults(scenario, agents),
        _sharing(scenario),
        _limits(scenario),
        _drag(scenario),
        _engine(scenario),
        _motors(scenario),
        _path(scenario),
        _on_the_ground(scenario),
        _network(scenario),
        _messages(scenario),
    ):
        for field, problem in problems:
            raise ScenarioError(source, field, problem)


def _ownership(scenario: Scenario) -> Iterator[Problem]:
    ids = [uav.id for uav in scenario.system.uav]
    if ids != list(range(1, len(ids) + 1)):
        yield "system.uav.id", f"expected 1, 2, ... {len(ids)} in order, got {ids}"
    owners: dict[int, int] = {}
    for agent, group in enumerate(scenario.owned, start=1):
        field = f"agents.owned.{agent}"
        for uav in group:
            if uav not in ids:
                yield field, f"expected ids of UAVs 1..{len(ids)}, got {uav}"
            if uav in owners:
                yield field, f"expected each UAV once, got UAV{uav}, owned by agent {owners[uav]}"
            owners[uav] = agent
    for uav in ids:
        if uav not in owners:
            yield "agents.owned", f"expected each UAV once, got none for UAV{uav}"


def _links(scenario: Scenario, agents: list[str]) -> Iterator[Problem]:
    links, names = scenario.links, [PLANT, *agents]
    expected = f"expected one of {', '.join(names)}"
    for place, section in links.all().items():
        field = f"links.{place}" if place else "links"
        if isinstance(section, LinkOverrideSection):
            for key, name in (("from", section.from_), ("to", section.to)):
                if name is not None and name not in names:
                    yield f"{field}.{key}", f"{expected}, got {name!r}"
        if section.distribution == "empirical" and section.samples is None:
            yield f"{field}.samples", "expected a file of measured delays, got nothing"
        changed = isinstance(section, LinkChangeSection) and section.samples is not None
        if changed and section.distribution != "empirical":
            text = "expected 'empirical' with samples, as a change names every changed key"
            yield f"{field}.distribution", f"{text}, got {section.distribution!r}"
    for i, partition in enumerate(links.partition, start=1):
        for name in partition.between:
            if name not in names:
                yield f"links.partition.{i}.between", f"{expected}, got {name!r}"
        if partition.end_s <= partition.start_s:
            text = f"expected more than start_s {partition.start_s}, got {partition.end_s}"
            yield f"links.partition.{i}.end_s", text


def _controller(scenario: Scenario) -> Iterator[Problem]:
    section = scenario.controller
    if section.terminal == "riccati" and section.weights.penalised_input == "absolute":
        expected = "expected 'deviation' with controller.terminal = 'riccati', whose optimum is hover"
        yield "controller.weights.penalised_input", f"{expected}, got 'absolute'"
    if section.preview and section.prediction == "open_loop" and section.terminal == "multiple":
        expected = "expected controller.prediction = 'closed_loop' or controller.terminal = 'riccati' with it"
        yield "controller.preview", f"{expected}, got neither"


def _clock(scenario: Scenario) -> Iterator[Problem]:
    clock, iterations = scenario.clock, scenario.controller.negotiation_iterations
    if clock.mode != "realtime":
        return
    if clock.speed == 0.0:
        yield "clock.speed", "expected a number > 0 with mode realtime, such as 1, got 0"
    if clock.actuation == "immediate":
        text = "expected 'next_tick' with mode realtime, where a step takes time, got 'immediate'"
        yield "clock.actuation", text
    if clock.exchange == "relayed":
        text = "expected 'direct' with mode realtime, where agents do not wait for the coordinator, got 'relayed'"
        yield "clock.exchange", text
    if iterations > 1:
        text = f"expected 1 with mode realtime, where agents do not wait for each other, got {iterations}"
        yield "controller.negotiation_iterations", text


def _faults(scenario: Scenario, agents: list[str]) -> Iterator[Problem]:
    processes = [COORDINATOR, PLANT, *agents]
    uavs = [f"uav{section.id}" for section in scenario.system.uav]
    state = dict.fromkeys([*processes, *uavs], "running")
    for i, event in sorted(enumerate(scenario.faults.event, start=1), key=lambda entry: entry[1].at_s):
        field, target = f"faults.event.{i}", event.target
        possible = uavs if event.do in OF_UAVS else processes
        if target not in possible:
            yield f"{field}.target", f"expected one of {', '.join(possible)}, got {target!r}"
        if event.do == "restart" and target not in agents:
            yield f"{field}.do", f"expected an agent to restart, as a run ends with its {target}, got 'restart'"
        if (event.do == "degrade") != (event.efficiency is not None):
            expected = "expected an efficiency" if event.do == "degrade" else "expected no efficiency without 'degrade'"
            yield f"{field}.efficiency", f"{expected}, got {event.efficiency or 'nothing'}"
        before, after = _FAULTS[event.do]
        if state[target] not in before:
            expected = f"expected an action possible for {target}, which is {state[target]} by then"
            yield f"{field}.do", f"{expected}, got {event.do!r}"
        state[target] = after
    grounded = scenario.plant.ground_m is not None and all(state[uav] == "released" for uav in uavs)
    if uavs and not grounded and all(state[uav] in ("off", "released") for uav in uavs):
        expected = "expected at least one UAV that keeps its motors"
        yield "faults.event", f"{expected}, got motor_off or release for all {len(uavs)}"


def _sharing(scenario: Scenario) -> Iterator[Problem]:
    """Sharing on change requires receivers that can predict the sender between two of its plans."""
    controller = scenario.controller
    if controller.share == "always":
        return
    for key, expected, why in (
        ("prediction", "closed_loop", "where other agents know the control law between two plans"),
        ("received_plans", "by_age", "as plans are used for longer than a period"),
        ("received_states", "predicted", "as states are used for longer than a period"),
        ("negotiation_iterations", 1, "as each iteration exchanges every plan"),
    ):
        got = getattr(controller, key)
        if got != expected:
            text = f"expected {expected!r} with controller.share 'on_change', {why}, got {got!r}"
            yield f"controller.{key}", text


def _limits(scenario: Scenario) -> Iterator[Problem]:
    period_s, step_s = scenario.controller.sampling_period_s, scenario.plant.step_s
    if step_s > period_s:
        yield "plant.step_s", f"expected at most the sampling period {period_s}, got {step_s}"


def _drag(scenario: Scenario) -> Iterator[Problem]:
    """Drag is held over a period, so above this bound it would reverse the motion it brakes; only in wind."""
    plant, system, period_s = scenario.plant, scenario.system, scenario.controller.sampling_period_s
    if not any([*plant.wind.speed_mps, *plant.wind.gust_mps]):
        return
    lightest = min(uav.mass_kg for uav in system.uav)
    for key, drag, mass in (
        ("drag_payload_kgps", plant.wind.drag_payload_kgps, plant.payload_mass_factor * system.payload.mass_kg),
        ("drag_uav_kgps", plant.wind.drag_uav_kgps, plant.uav_mass_factor * lightest),
    ):
        if drag * period_s > mass:
            expected = f"expected at most mass over sampling period {mass / period_s:g}"
            yield f"plant.wind.{key}", f"{expected}, got {drag}"


def _engine(scenario: Scenario) -> Iterator[Problem]:
    """Settings without effect on the engine, a ground that the path goes through, and steps too long for contacts."""
    plant, period_s = scenario.plant, scenario.controller.sampling_period_s
    expected = "expected plant.engine = 'mujoco' or an engine of your own with it"
    if plant.engine == "rods":
        if plant.ground_m is not None:
            yield "plant.ground_m", f"{expected}, got 'rods', which has no ground"
        if plant.mujoco != MujocoSection():
            yield "plant.mujoco", f"{expected}, got 'rods'"
    if plant.mujoco.step_s > min(period_s, LONGEST_MUJOCO_STEP_S):
        expected = (
            f"expected at most the sampling period {period_s} and {LONGEST_MUJOCO_STEP_S} s, as contacts are stiff"
        )
        yield "plant.mujoco.step_s", f"{expected}, got {plant.mujoco.step_s}"
    if plant.mujoco.suspension == "cables":
        for event in scenario.faults.event:
            if event.do == "release":
                yield "plant.mujoco.suspension", "expected 'rods' with a fault 'release', got 'cables'"


def _motors(scenario: Scenario) -> Iterator[Problem]:
    """A lag is none, or long enough for the exponential of the discretisation."""
    plant, controller = scenario.plant, scenario.controller
    period_s = controller.sampling_period_s
    for key, lag_s in (("controller.motor_lag_s", controller.motor_lag_s), ("plant.motors.lag_s", plant.motors.lag_s)):
        if 0.0 < lag_s < _SHORTEST_LAG * period_s:
            expected = f"expected 0 or at least a hundredth of the sampling period, {_SHORTEST_LAG * period_s:g}"
            yield key, f"{expected}, got {lag_s}"


def _path(scenario: Scenario) -> Iterator[Problem]:
    """A path stays where float64 resolves positions to well below a millimetre, and where measurements are valid."""
    expected = f"expected a path within {FURTHEST_M:g} m of the origin"
    reached = scenario.maneuver.start_m
    if max(map(abs, reached)) > FURTHEST_M:
        yield "maneuver.start_m", f"{expected}, got {list(reached)}"
    for i, phase in enumerate(scenario.maneuver.phase, start=1):
        places = [place for _, *place in phase.way or [] if len(place) == len(reached)]
        for way in [*places, phase.displacement_m]:
            furthest = max(abs(a + b) for a, b in zip(reached, way, strict=True))
            if furthest > FURTHEST_M:
                key = "way" if phase.way else "displacement_m"
                yield f"maneuver.phase.{i}.{key}", f"{expected}, got {furthest:g} m"
        reached = tuple(a + b for a, b in zip(reached, phase.displacement_m, strict=True))


def _on_the_ground(scenario: Scenario) -> Iterator[Problem]:
    """Take-offs and landings are vertical, and need a ground."""
    for i, phase in enumerate(scenario.maneuver.phase, start=1):
        if phase.kind == "move":
            continue
        field, (x, y, z) = f"maneuver.phase.{i}", phase.displacement_m
        if scenario.plant.ground_m is None:
            yield f"{field}.kind", f"expected plant.ground_m with it, got {phase.kind!r} without a ground"
        if phase.way is not None:
            yield f"{field}.kind", f"expected 'move' with a path from a file, got {phase.kind!r}"
        if x != 0.0 or y != 0.0 or (z >= 0.0 if phase.kind == "take_off" else z <= 0.0):
            direction = "up, negative z" if phase.kind == "take_off" else "down, positive z"
            yield f"{field}.displacement_m", f"expected a path straight {direction}, got {list(phase.displacement_m)}"


def _network(scenario: Scenario) -> Iterator[Problem]:
    router = scenario.network.router
    if router is not None and not re.fullmatch(r"(tcp|tls)/\S+:\d+", router):
        yield "network.router", f"expected an endpoint such as tls/192.0.2.1:7447, got {router!r}"


def _messages(scenario: Scenario) -> Iterator[Problem]:
    """The largest message, plans and reports of a tick, fits into what every receiver accepts."""
    if not scenario.clock.relayed:
        return
    size = estimate(scenario).relay_bytes
    if size > MAX_BYTES:
        text = f"expected plans of a tick of at most {MAX_BYTES:,} bytes in one message, got {size:,.0f}"
        yield "controller.horizon", f"{text}; set clock.exchange = 'direct', or a shorter horizon"
