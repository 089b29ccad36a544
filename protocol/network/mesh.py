"""Mesh of a run: the endpoints of all its processes, from its scenario."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from transport.protocol.network.endpoints import DEFAULT_BASE_PORT, Endpoints
from transport.protocol.network.security import Security
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.wire.key_expressions import RECORDER
from transport.protocol.wire.names import COORDINATOR, PLANT, agent_name, vehicle_name


def process_names(scenario: Scenario) -> list[str]:
    """Return the names of a run's processes in the order of their ports."""
    agents = [agent_name(agent + 1) for agent in range(len(scenario.owned))]
    vehicles = [vehicle_name(uav.id) for uav in scenario.system.uav]
    return [
        COORDINATOR,
        *([PLANT] if scenario.has_plant else []),
        *agents,
        *(vehicles if scenario.has_vehicles else []),
    ]


def security_of(scenario: Scenario) -> Security | None:
    """Return the keys of this host and the processes that may use them; None without keys."""
    keys = scenario.network.keys
    if keys is None:
        return None
    return Security(Path(keys).resolve(), (*process_names(scenario), RECORDER))


def mesh(scenario: Scenario, names: Sequence[str], ports: Sequence[int]) -> dict[str, Endpoints]:
    """Return the endpoints of processes with a port each.

    They are clients of the router if there is one; otherwise each connects to those before.
    """
    network = scenario.network
    security = security_of(scenario)
    if network.router is not None:
        client = Endpoints(listen=[], connect=[network.router], mode="client", security=security)
        return dict.fromkeys(names, client)

    scheme = "tcp" if security is None else security.scheme
    places = [f"{scheme}/{network.host}:{port}" for port in ports]
    return {
        name: Endpoints(listen=[places[i]], connect=places[:i], security=security)
        for i, name in enumerate(names)
    }


def default_mesh(scenario: Scenario) -> dict[str, Endpoints]:
    """Return the endpoints of processes started by hand: consecutive ports from the base port."""
    names = process_names(scenario)
    base = scenario.network.base_port or DEFAULT_BASE_PORT
    return mesh(scenario, names, range(base, base + len(names)))


def endpoints_of(
    name: str,
    scenario: Scenario,
    listen: Sequence[str] | None = None,
    connect: Sequence[str] | None = None,
) -> Endpoints:
    """Return the endpoints of a process started by itself.

    As given, by default those of its scenario; an observer connects to all processes.
    """
    team = default_mesh(scenario)
    everywhere = [place for endpoints in team.values() for place in endpoints.listen]
    reached = everywhere or team[COORDINATOR].connect
    observer = replace(team[COORDINATOR], listen=[], connect=reached)

    usual = team.get(name, observer)
    if listen is None and connect is None:
        return usual.checked(name, insecure=scenario.network.insecure)
    listens = usual.listen if listen is None else listen
    connects = usual.connect if connect is None and listen is None else connect or []
    mode = "peer" if listens else usual.mode
    given = replace(usual, listen=listens, connect=connects, mode=mode)
    return given.checked(name, insecure=scenario.network.insecure)
