"""Endpoints: where the processes of a run listen, and which others they connect to."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from protocol.network.security import Security, SecurityError, exposed
from protocol.scenario.schema import Scenario
from protocol.wire.keys import RECORDER
from protocol.wire.messages import agent_name
from protocol.wire.names import COORDINATOR, PLANT

DEFAULT_BASE_PORT = 7447


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoints:
    """Where a process listens, and which others it connects to: Zenoh endpoints such as "tcp/127.0.0.1:7447"."""

    listen: Sequence[str]  # none for an observer or a client
    connect: Sequence[str]  # each pair of processes is connected once
    mode: Literal["peer", "client", "router"] = "peer"
    security: Security | None = None  # None: every process that can connect may send everything


def process_names(scenario: Scenario) -> list[str]:
    """Return the names of a run's processes in the order of their ports."""
    return [COORDINATOR, PLANT, *[agent_name(agent + 1) for agent in range(len(scenario.owned))]]


def security_of(scenario: Scenario) -> Security | None:
    """Return the keys of this host and the processes that may use them; None without keys."""
    keys = scenario.network.keys
    return None if keys is None else Security(Path(keys).resolve(), (*process_names(scenario), RECORDER))


def mesh(
    names: Sequence[str], host: str, ports: Sequence[int], security: Security | None = None
) -> dict[str, Endpoints]:
    """Return the endpoints of a mesh: each process listens on its port and connects to those listed before it."""
    scheme = "tcp" if security is None else security.scheme
    addresses = [f"{scheme}/{host}:{port}" for port in ports]
    return {
        name: Endpoints(listen=[addresses[i]], connect=addresses[:i], security=security) for i, name in enumerate(names)
    }


def endpoints_of_all(
    names: Sequence[str], scenario: Scenario, ports: Sequence[int], *, check: bool = True
) -> dict[str, Endpoints]:
    """Return the endpoints of a scenario's processes, with a port each: a mesh on its host, or clients of its router.

    `check` if all of them start on this host: then each must have its keys, and listen where it may.

    Raises: SecurityError: keys that one of them cannot use, or an endpoint that is open to all.
    """
    network, security = scenario.network, security_of(scenario)
    if network.router is None:
        found = mesh(names, network.host, ports, security)
    else:
        client = Endpoints(listen=[], connect=[network.router], mode="client", security=security)
        found = dict.fromkeys(names, client)
    if security is not None and network.router is not None and not network.router.startswith(security.scheme):
        expected = f"expected {security.scheme}/... with the keys in {security.folder}, got {network.router}"
        raise SecurityError(f"network.router: {expected}")
    for name, endpoints in found.items() if check else ():
        if security is not None:
            security.check(name, mode=endpoints.mode)
        refuse_exposed(endpoints, scenario)
    return found


def default_mesh(scenario: Scenario) -> dict[str, Endpoints]:
    """Return the endpoints of processes that are started by hand: consecutive ports from the base port.

    Raises: SecurityError: keys that cannot be used.
    """
    names = process_names(scenario)
    base = scenario.network.base_port or DEFAULT_BASE_PORT
    return endpoints_of_all(names, scenario, range(base, base + len(names)), check=False)


def endpoints_of(
    name: str, scenario: Scenario, listen: Sequence[str] | None = None, connect: Sequence[str] | None = None
) -> Endpoints:
    """Return the endpoints of a process that is started by itself: those of its scenario, or the given ones.

    A process that the mesh lacks listens nowhere and connects to all.

    Raises: SecurityError: keys that it cannot use, or an endpoint that is open to all.
    """
    usual = default_mesh(scenario)
    if name in usual:
        found = usual[name]
    elif scenario.network.router is not None:
        found = usual[COORDINATOR]
    else:
        everywhere = [at for endpoints in usual.values() for at in endpoints.listen]
        found = Endpoints(listen=[], connect=everywhere, security=security_of(scenario))
    if listen is not None or connect is not None:
        listens = found.listen if listen is None else listen
        calls = found.connect if connect is None and listen is None else connect or []
        found = replace(found, listen=listens, connect=calls, mode="peer" if listens else found.mode)
    if found.security is not None:
        found.security.check(name, mode=found.mode)
        wrong = [at for at in (*found.listen, *found.connect) if not at.startswith(f"{found.security.scheme}/")]
        if wrong:
            raise SecurityError(f"network.keys: expected {found.security.scheme}/... with these keys, got {wrong[0]}")
    refuse_exposed(found, scenario)
    return found


def refuse_exposed(endpoints: Endpoints, scenario: Scenario) -> None:
    """Refuse to listen unencrypted where other hosts can connect, unless the scenario says `insecure`.

    Raises: SecurityError: naming the endpoint.
    """
    at = exposed(endpoints.listen)
    if at is not None and not scenario.network.insecure:
        expected = "expected a loopback address, or network.keys, or network.insecure = true to be open to all"
        raise SecurityError(f"network.host: {expected}, got {at}")
