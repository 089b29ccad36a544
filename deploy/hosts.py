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


class DeployError(TransportError, ValueError):
    """An inventory, keys or folders that cannot be used; the text has file or option, expected and got."""


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


@dataclass(frozen=True, slots=True)
class Placement:
    """Placement of a process on a host."""

    process: str
    host: Host
    endpoints: Endpoints


def read_inventory(path: Path, processes: Sequence[str]) -> Inventory:
    """Read an inventory, with each process on one host. Raises: DeployError: naming file, field, expected and got."""
    try:
        inventory = validated(Inventory, read_tree(path), str(path))
    except ScenarioError as error:
        raise DeployError(str(error)) from error
    for field, problem in _problems(inventory, processes):
        raise DeployError(f"{path}: {field}: {problem}")
    return inventory


def placements(inventory: Inventory, processes: Sequence[str], scheme: str) -> list[Placement]:
    """Return the placement of every process of a run, recorder and routers included; processes in the mesh's order."""
    base, routers, found = inventory.base_port, inventory.routers, []

    def endpoint(address: str, port: int) -> str:
        return f"{scheme}/[{address}]:{port}" if ":" in address else f"{scheme}/{address}:{port}"

    calls = [endpoint(host.address, base) for host in routers]
    for i, host in enumerate(routers):
        listen = [endpoint(host.listen or host.address, base)]
        found.append(Placement(ROUTER, host, Endpoints(listen=listen, connect=calls[:i], mode="router")))
    earlier: list[str] = []  # endpoints of the processes before
    for port, name in enumerate([*processes, RECORDER], start=base):
        for host in (host for host in inventory.host if name in host.runs):
            if routers:  # its client: of the one named, its own, or the first
                at = next((r for r in routers if r.name == (host.router or host.name)), routers[0])
                ends = Endpoints(listen=[], connect=[endpoint(at.address, base)], mode="client")
            else:
                listen = [] if name == RECORDER else [endpoint(host.listen or host.address, port)]
                ends = Endpoints(listen=listen, connect=list(earlier))
            found.append(Placement(name, host, ends))
            earlier.append(endpoint(host.address, port))
    return found


def _problems(inventory: Inventory, processes: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield field, and expected and got, of hosts and processes that do not fit."""
    known, names = [*processes, RECORDER, ROUTER], [host.name for host in inventory.host]
    runs = Counter(process for host in inventory.host for process in host.runs)
    routers = [host.name for host in inventory.routers]
    for i, host in enumerate(inventory.host, start=1):
        if host.name in names[: i - 1]:
            yield f"host.{i}.name", f"expected each host once, got {host.name!r} again"
        if host.router is not None and host.router not in routers:
            yield f"host.{i}.router", f"expected a host that runs a router, one of {routers}, got {host.router!r}"
        for key, some, allowed in (("runs", host.runs, known), ("cpus", host.cpus, host.runs)):
            for process in some:
                if process not in allowed:
                    yield f"host.{i}.{key}", f"expected one of {', '.join(allowed)}, got {process!r}"
    for process in [*processes, RECORDER]:
        if runs[process] > 1 or (runs[process] == 0 and process != RECORDER):
            yield "host", f"expected one host that runs {process}, got {runs[process]}"
