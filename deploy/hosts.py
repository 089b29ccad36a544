"""Inventory of hosts and their processes, and from it the endpoints of every process of a run."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from mpc.settings import Section
from protocol.network.endpoints import DEFAULT_BASE_PORT, Endpoints
from protocol.scenario.errors import ScenarioError, validated
from protocol.scenario.file import read_tree
from protocol.wire.errors import TransportError
from protocol.wire.keys import RECORDER, ROUTER


class InventoryError(TransportError, ValueError):
    """An invalid inventory: `file: field: expected ..., got ...`."""


Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,40}$")]
Address = Annotated[str, Field(pattern=r"^[A-Za-z0-9.:_-]{1,253}$")]


class Host(Section):
    """One host."""

    name: Name  # of its folder
    address: Address  # that the other hosts connect to
    runs: Annotated[list[Name], Field(min_length=1)]  # processes: coordinator, plant, agent1, ..., recorder, router
    listen: Address | None = None  # if it is not `address` (in a container 0.0.0.0)
    router: Name | None = None  # host whose router its processes connect to
    cpus: dict[Name, list[Annotated[int, Field(ge=0, le=4095)]]] = {}  # processors by process
    priority: Annotated[int, Field(ge=0, le=50)] = 0  # SCHED_FIFO priority of its processes, 0 for none


class Inventory(Section):
    """A deployment; docs/deploy.md describes each key."""

    run: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,80}$")]
    base_port: Annotated[int, Field(ge=1024, le=65_000)] = DEFAULT_BASE_PORT
    insecure: bool = False
    host: Annotated[list[Host], Field(min_length=1)]

    @property
    def routers(self) -> list[Host]:
        """Hosts that run a router, in order."""
        return [host for host in self.host if ROUTER in host.runs]

    def router_of(self, host: Host) -> Host | None:
        """Return the host whose router a host uses: the one named, its own, or the first; None in a mesh."""
        if host.router is not None:
            return next(other for other in self.host if other.name == host.router)
        return host if host in self.routers else next(iter(self.routers), None)


@dataclass(frozen=True, slots=True)
class Placement:
    """Placement of a process on a host."""

    process: str
    host: Host
    endpoints: Endpoints


def read_inventory(path: Path, processes: Sequence[str]) -> Inventory:
    """Read and check an inventory; each of the processes named has to run on one host.

    Raises: InventoryError: naming file, field, expected and got.
    """
    try:
        inventory = validated(Inventory, read_tree(path), str(path))
    except ScenarioError as error:
        raise InventoryError(str(error)) from error
    for field, problem in _problems(inventory, processes):
        raise InventoryError(f"{path}: {field}: {problem}")
    return inventory


def placements(inventory: Inventory, processes: Sequence[str], scheme: str) -> list[Placement]:
    """Return the placement of every process of a run, recorder and routers included; processes in the mesh's order."""

    def endpoint(address: str, port: int) -> str:
        return f"{scheme}/[{address}]:{port}" if address.count(":") > 1 else f"{scheme}/{address}:{port}"

    found = []
    ports = {name: inventory.base_port + place for place, name in enumerate([*processes, RECORDER])}
    earlier: list[str] = []  # endpoints of the processes before
    routers: list[str] = []
    for at in inventory.routers:
        listen = [endpoint(at.listen or at.address, inventory.base_port)]
        found.append(Placement(ROUTER, at, Endpoints(listen=listen, connect=list(routers), mode="router")))
        routers.append(endpoint(at.address, inventory.base_port))
    for name in [*processes, RECORDER]:
        host = next((host for host in inventory.host if name in host.runs), None)
        if host is None:
            continue  # the recorder is optional
        router = inventory.router_of(host)
        if router is not None:
            connect = [endpoint(router.address, inventory.base_port)]
            found.append(Placement(name, host, Endpoints(listen=[], connect=connect, mode="client")))
            continue
        listen = [] if name == RECORDER else [endpoint(host.listen or host.address, ports[name])]
        found.append(Placement(name, host, Endpoints(listen=listen, connect=list(earlier))))
        earlier.append(endpoint(host.address, ports[name]))
    return found


def _problems(inventory: Inventory, processes: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield field, and expected and got, of hosts and processes that do not fit."""
    known, names = [*processes, RECORDER, ROUTER], Counter(host.name for host in inventory.host)
    runs = Counter(process for host in inventory.host for process in host.runs)
    routers = [host.name for host in inventory.routers]
    for i, host in enumerate(inventory.host, start=1):
        if names[host.name] > 1:
            yield f"host.{i}.name", f"expected each host once, got {host.name!r} again"
        for process in host.runs:
            if process not in known:
                yield f"host.{i}.runs", f"expected one of {', '.join(known)}, got {process!r}"
            if runs[process] > 1 and process != ROUTER:
                yield f"host.{i}.runs", f"expected each process on one host, got {process} on {runs[process]}"
        for process in set(host.cpus) - set(host.runs):
            yield f"host.{i}.cpus", f"expected one of {', '.join(host.runs)}, got {process!r}"
        if host.router is not None and host.router not in routers:
            expected = f"expected a host that runs a router ({', '.join(routers) or 'none does'})"
            yield f"host.{i}.router", f"{expected}, got {host.router!r}"
    for process in processes:
        if not runs[process]:
            yield "host", f"expected a host that runs {process}, got none"
