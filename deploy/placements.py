"""Placement of each process of a run: its host, and the endpoints that it listens on and connects to."""

from collections.abc import Sequence
from dataclasses import dataclass

from transport.deploy.inventory import Host, Inventory
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.wire.key_expressions import RECORDER, ROUTER


@dataclass(frozen=True, slots=True)
class Placement:
    """Placement of a process on a host."""

    process: str
    host: Host
    endpoints: Endpoints


def placements(inventory: Inventory, processes: Sequence[str], scheme: str) -> list[Placement]:
    """Return the placement of every process of a run, recorder and routers included.

    Routers come first, then the processes in the order of their ports.
    """
    if inventory.routers:
        return [*_routers(inventory, scheme), *_clients(inventory, processes, scheme)]
    return _peers(inventory, processes, scheme)


def _endpoint(scheme: str, address: str, port: int) -> str:
    """Return the endpoint of an address, which may be one of IPv6."""
    host = f"[{address}]" if ":" in address else address
    return f"{scheme}/{host}:{port}"


def _routers(inventory: Inventory, scheme: str) -> list[Placement]:
    """Return the placements of the routers, each connected to those before."""
    port = inventory.base_port
    places = [_endpoint(scheme, host.address, port) for host in inventory.routers]
    routers = []
    for i, host in enumerate(inventory.routers):
        listen = [_endpoint(scheme, host.listening_address, port)]
        endpoints = Endpoints(listen=listen, connect=places[:i], mode="router")
        routers.append(Placement(ROUTER, host, endpoints))
    return routers


def _clients(inventory: Inventory, processes: Sequence[str], scheme: str) -> list[Placement]:
    """Return the placements of the processes as clients of a router.

    The router of a process is the one that its host names, else that of its host, else the first.
    """
    clients = []
    for name in [*processes, RECORDER]:
        for host in inventory.hosts_of(name):
            wanted = host.router or host.name
            own = [each for each in inventory.routers if each.name == wanted]
            router = (own or inventory.routers)[0]
            place = _endpoint(scheme, router.address, inventory.base_port)
            endpoints = Endpoints(listen=[], connect=[place], mode="client")
            clients.append(Placement(name, host, endpoints))
    return clients


def _peers(inventory: Inventory, processes: Sequence[str], scheme: str) -> list[Placement]:
    """Return the placements of peers, each connected to those before.

    The recorder connects to all and listens nowhere.
    """
    peers = []
    earlier: list[str] = []
    for port, name in enumerate(processes, start=inventory.base_port):
        for host in inventory.hosts_of(name):
            listen = [_endpoint(scheme, host.listening_address, port)]
            endpoints = Endpoints(listen=listen, connect=list(earlier))
            peers.append(Placement(name, host, endpoints))
            earlier.append(_endpoint(scheme, host.address, port))

    for host in inventory.hosts_of(RECORDER):
        peers.append(Placement(RECORDER, host, Endpoints(listen=[], connect=earlier)))
    return peers
