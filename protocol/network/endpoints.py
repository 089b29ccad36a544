"""Endpoints: where the processes of a run listen, and which others they connect to."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from transport.protocol.network.security import Security, SecurityError, exposed
from transport.protocol.scenario.schema import Scenario
from transport.protocol.wire.keys import RECORDER
from transport.protocol.wire.messages import agent_name
from transport.protocol.wire.names import COORDINATOR, PLANT

DEFAULT_BASE_PORT = 7447


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoints:
    """Where a process listens, and which others it connects to.

    Zenoh endpoints such as "tcp/127.0.0.1:7447".
    """

    listen: Sequence[str]  # none for an observer or a client
    connect: Sequence[str]  # each pair of processes is connected once
    mode: Literal["peer", "client", "router"] = "peer"
    security: Security | None = None  # None: every process that can connect may send everything

    def checked(self, name: str, scenario: Scenario) -> "Endpoints":
        """Return these endpoints, or raise SecurityError.

        Unusable keys, or none, not `insecure`, beyond loopback.
        """
        if self.security is not None:
            self.security.check(name)
            scheme = f"{self.security.scheme}/"
            if wrong := [at for at in (*self.listen, *self.connect) if not at.startswith(scheme)]:
                raise SecurityError(
                    f"network.keys: expected {scheme}... with these keys, got {wrong[0]}"
                )
        if (at := exposed(self.listen)) and not scenario.network.insecure:
            expected = "expected a loopback address, or network.keys, or network.insecure = true to be open to all"
            raise SecurityError(f"network.host: {expected}, got {at}")
        return self


def process_names(scenario: Scenario) -> list[str]:
    """Return the names of a run's processes in the order of their ports."""
    return [COORDINATOR, PLANT, *[agent_name(agent + 1) for agent in range(len(scenario.owned))]]


def security_of(scenario: Scenario) -> Security | None:
    """Return the keys of this host and the processes that may use them; None without keys."""
    keys = scenario.network.keys
    return (
        None
        if keys is None
        else Security(Path(keys).resolve(), (*process_names(scenario), RECORDER))
    )


def mesh(scenario: Scenario, names: Sequence[str], ports: Sequence[int]) -> dict[str, Endpoints]:
    """Return the endpoints of processes with a port each.

    Clients of the router, or each connected to those before.
    """
    network, security = scenario.network, security_of(scenario)
    if network.router is not None:
        client = Endpoints(listen=[], connect=[network.router], mode="client", security=security)
        return dict.fromkeys(names, client)
    scheme = "tcp" if security is None else security.scheme
    at = [f"{scheme}/{network.host}:{port}" for port in ports]
    return {
        name: Endpoints(listen=[at[i]], connect=at[:i], security=security)
        for i, name in enumerate(names)
    }


def default_mesh(scenario: Scenario) -> dict[str, Endpoints]:
    """Return the endpoints of processes that are started by hand.

    Consecutive ports from the base port.
    """
    names, base = process_names(scenario), scenario.network.base_port or DEFAULT_BASE_PORT
    return mesh(scenario, names, range(base, base + len(names)))


def endpoints_of(
    name: str,
    scenario: Scenario,
    listen: Sequence[str] | None = None,
    connect: Sequence[str] | None = None,
) -> Endpoints:
    """Return the endpoints of a process started by itself.

    As given, of its scenario, or connected to all.
    """
    usual = default_mesh(scenario)
    everywhere = [at for endpoints in usual.values() for at in endpoints.listen]
    observer = replace(
        usual[COORDINATOR], listen=[], connect=everywhere or usual[COORDINATOR].connect
    )
    found = usual.get(name, observer)
    if listen is not None or connect is not None:
        listens = found.listen if listen is None else listen
        calls = found.connect if connect is None and listen is None else connect or []
        found = replace(
            found, listen=listens, connect=calls, mode="peer" if listens else found.mode
        )
    return found.checked(name, scenario)
