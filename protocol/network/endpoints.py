"""Endpoints: where the processes of a run listen, and which others they connect to."""

import ipaddress
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from transport.protocol.network.security import Security, SecurityError
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.wire.key_expressions import RECORDER
from transport.protocol.wire.messages import agent_name
from transport.protocol.wire.names import COORDINATOR, PLANT, vehicle_name

DEFAULT_BASE_PORT = 7447


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoints:
    """Zenoh endpoints of a process, such as "tcp/127.0.0.1:7447"."""

    listen: Sequence[str]  # none for an observer or a client
    connect: Sequence[str]  # each pair of processes is connected once
    mode: Literal["peer", "client", "router"] = "peer"
    security: Security | None = None  # None: every process that can connect may send everything

    def checked(self, name: str, scenario: Scenario) -> "Endpoints":
        """Return these endpoints if a process may use them.

        Raises: SecurityError: unusable keys, or none beyond loopback without `network.insecure`.
        """
        if self.security is not None:
            self._check_scheme(self.security, name)
        open_to_all = first_exposed(self.listen)
        if open_to_all and not scenario.network.insecure:
            expected = (
                "expected a loopback address, or network.keys, or network.insecure = true to be "
                "open to all"
            )
            raise SecurityError(f"network.host: {expected}, got {open_to_all}")
        return self

    def in_words(self) -> str:
        """Return where the process listens and connects to; with a router it does not listen."""
        parts = {"listens on": self.listen, "connects to": self.connect}
        told = [f"{verb} {', '.join(ends)}" for verb, ends in parts.items() if ends]
        return ", ".join(told)

    def _check_scheme(self, security: Security, name: str) -> None:
        """Refuse endpoints without the protocol of the keys. Raises: SecurityError."""
        security.check(name)
        scheme = f"{security.scheme}/"
        for endpoint in (*self.listen, *self.connect):
            if not endpoint.startswith(scheme):
                expected = f"expected {scheme}... with these keys"
                raise SecurityError(f"network.keys: {expected}, got {endpoint}")


def first_exposed(endpoints: Sequence[str]) -> str | None:
    """Return the first endpoint that is not encrypted and that other hosts can reach, or None."""
    for endpoint in endpoints:
        protocol, _, address = endpoint.partition("/")
        host = address.rpartition(":")[0].strip("[]")
        is_local = host == "localhost"
        with suppress(ValueError):  # a name
            is_local = ipaddress.ip_address(host).is_loopback
        if protocol in ("tcp", "udp", "ws") and not is_local:
            return endpoint
    return None


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
        return usual.checked(name, scenario)
    listens = usual.listen if listen is None else listen
    connects = usual.connect if connect is None and listen is None else connect or []
    mode = "peer" if listens else usual.mode
    given = replace(usual, listen=listens, connect=connects, mode=mode)
    return given.checked(name, scenario)
