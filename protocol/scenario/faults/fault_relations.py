"""Relations between scripted faults, their targets and the rest of a scenario."""

from collections.abc import Collection, Iterator

from transport.model.physics.parameters import ParameterError, Payload
from transport.protocol.scenario.faults.faults_by_tick import OF_UAVS
from transport.protocol.scenario.sections.fault_sections import FaultSection
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.wire.names import COORDINATOR, PLANT, agent_name, vehicle_name

Problems = Iterator[tuple[str, str, object]]  # field, what was expected there, and what came


def processes_of(scenario: Scenario) -> list[str]:
    """Return the names of plant and agents."""
    return [PLANT, *(agent_name(agent) for agent in range(1, len(scenario.owned) + 1))]


def fault_problems(scenario: Scenario) -> Problems:
    """Yield faults of targets that do not exist, or at a time at which they are not possible."""
    events = sorted(enumerate(scenario.faults.event, start=1), key=lambda entry: entry[1].at_s)
    last: dict[str, str] = {}  # action on each target
    for i, event in events:
        field = f"faults.event.{i}"
        yield from _fault(scenario, event, field)

        before = last.get(event.target, "start")
        is_gone = event.do == "stop" and before == "kill"
        is_running = event.do == "continue" and before != "stop"
        if before == "release" or is_gone or is_running:
            expected = f"an action possible for {event.target} after its {before}"
            yield f"{field}.do", expected, repr(event.do)
        last[event.target] = event.do

    yield from _last_uav(scenario, last)


def _fault(scenario: Scenario, event: FaultSection, field: str) -> Problems:
    """Yield what is wrong with one fault, whatever the others."""
    possible = _targets_of(scenario, event)
    if event.target not in possible:
        yield f"{field}.target", f"one of {', '.join(possible)}", repr(event.target)

    yield from _keys_of_actions(event, field)
    if event.do == "sensors_off" and scenario.plant.sensors != "vehicle":
        yield f"{field}.do", "plant.sensors = 'vehicle' with 'sensors_off'", "'state'"

    if event.do == "motor_off" and scenario.maneuver.reference == "flat":
        yield f"{field}.do", "'release' with maneuver.reference = 'flat'", "'motor_off'"


def _keys_of_actions(event: FaultSection, field: str) -> Problems:
    """Yield keys that the action of a fault lacks, or that are of another one."""
    for key, action, value in (
        ("efficiency", "degrade", "an efficiency"),
        ("sensors", "sensors_off", "sensors"),
    ):
        given = getattr(event, key)
        is_needed = event.do == action
        if is_needed != (given is not None):
            expected = f"{value} with {action!r}" if is_needed else f"no {key} without {action!r}"
            yield f"{field}.{key}", expected, given or "nothing"
    if event.duration_s is not None and event.do not in ("sensors_off", "load"):
        yield f"{field}.duration_s", "no value without 'sensors_off' or 'load'", event.duration_s

    given = {key: getattr(event, key) for key in ("mass_kg", "inertia_kgm2", "centre_m")}
    changes = [key for key, value in given.items() if value is not None]
    if event.do == "load" and not changes:
        yield f"{field}.do", f"{', '.join(given)} or some of them with 'load'", "none"
    if event.do != "load" and changes:
        yield f"{field}.{changes[0]}", f"no {changes[0]} without 'load'", given[changes[0]]
    if event.inertia_kgm2 is not None:
        try:
            Payload(mass=1.0, inertia=event.inertia_kgm2)
        except ParameterError as error:
            yield f"{field}.inertia_kgm2", "the inertia of a body", str(error)


def _targets_of(scenario: Scenario, event: FaultSection) -> Collection[str]:
    """Return the targets that the action of a fault may have."""
    if event.do == "load":
        return ["payload"]
    if event.do in OF_UAVS:
        return [f"uav{section.id}" for section in scenario.system.uav]

    plant, *agents = processes_of(scenario)
    returning = agents
    if scenario.has_vehicles:
        returning = [*agents, *(vehicle_name(uav.id) for uav in scenario.system.uav)]
    if event.do == "restart":
        goes_on = scenario.clock.on_coordinator_loss == "continue"
        return [COORDINATOR, *returning] if goes_on else returning
    plants = [plant] if scenario.has_plant else []
    return [COORDINATOR, *plants, *returning]


def _last_uav(scenario: Scenario, last: dict[str, str]) -> Problems:
    """Yield a run that no UAV flies, unless the payload was set down on the ground before."""
    uavs = [f"uav{section.id}" for section in scenario.system.uav]
    without_motors = {
        event.target for event in scenario.faults.event if event.do in ("motor_off", "release")
    }
    has_ground = scenario.plant.ground_m is not None
    is_set_down = has_ground and all(last.get(uav) == "release" for uav in uavs)
    if not is_set_down and without_motors.issuperset(uavs):
        got = f"motor_off or release for all {len(uavs)}"
        yield "faults.event", "at least one UAV that keeps its motors", got
