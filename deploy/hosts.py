"""Inventory of hosts and their processes, and from it the endpoints of every process of a run."""

import difflib
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from protocol.network.endpoints import DEFAULT_BASE_PORT, Endpoints
from protocol.wire.errors import TransportError
from protocol.wire.keys import RECORDER, ROUTER


class InventoryError(TransportError, ValueError):
    """An invalid inventory: `file: field: expected ..., got ...`."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,40}$")]
Address = Annotated[str, Field(pattern=r"^[A-Za-z0-9.:_-]{1,253}$")]


class Host(_Section):
    """One host."""

    name: Name  # of its folder
    address: Address  # that the other hosts connect to
    runs: Annotated[list[Name], Field(min_length=1)]  # processes: coordinator, plant, agent1, ..., recorder, router
    listen: Address | None = None  # if it is not `address` (in a container 0.0.0.0)
    router: Name | None = None  # host whose router its processes connect to
    cpus: dict[Name, list[Annotated[int, Field(ge=0, le=4095)]]] = {}  # processors by process
    priority: Annotated[int, Field(ge=0, le=50)] = 0  # SCHED_FIFO priority of its processes, 0 for none


class Inventory(_Section):
    """A deployment; docs/deploy.md describes each key."""

    run: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,80}$")]
    base_port: Annotated[int, Field(ge=1024, le=65_000)] = DEFAULT_BASE_PORT
    insecure: bool = False
    host: Annotated[list[Host], Field(min_length=1)]

    def of(self, process: str) -> Host:
        """Return the host that runs a process."""
        return next(host for host in self.host if process in host.runs)

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
    """Read and check an inventory.

    Args:
        path: TOML file.
        processes: Names of the run's processes; each has to run on one host.
    Raises: InventoryError: naming file, field, expected and got.
    """
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
        inventory = Inventory.model_validate(tree)
    except OSError as error:
        raise InventoryError(f"{path}: cannot be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InventoryError(f"{path}: not valid TOML: {error}") from error
    except ValidationError as error:
        problem = error.errors()[0]
        field = ".".join(str(part + 1) if isinstance(part, int) else part for part in problem["loc"])
        raise InventoryError(f"{path}: {field}: {problem['msg']}, got {problem['input']!r}"[:300]) from error
    _check(inventory, str(path), processes)
    return inventory


def placements(inventory: Inventory, processes: Sequence[str], scheme: str) -> list[Placement]:
    """Return the placement of every process of a run, recorder and routers included; processes in the mesh's order."""

    def endpoint(address: str, port: int) -> str:
        return f"{scheme}/[{address}]:{port}" if address.count(":") > 1 else f"{scheme}/{address}:{port}"

    found = []
    ports = {name: inventory.base_port + place for place, name in enumerate([*processes, RECORDER])}
    earlier: list[str] = []  # endpoints of the processes before
    for position, host in enumerate(inventory.routers):
        at = endpoint(host.listen or host.address, inventory.base_port)
        others = [endpoint(other.address, inventory.base_port) for other in inventory.routers[:position]]
        found.append(Placement(ROUTER, host, Endpoints(listen=[at], connect=others, mode="router")))
    for name in [*processes, RECORDER]:
        if not any(name in host.runs for host in inventory.host):
            continue  # the recorder is optional
        host = inventory.of(name)
        router = inventory.router_of(host)
        if router is not None:
            at = endpoint(router.address, inventory.base_port)
            found.append(Placement(name, host, Endpoints(listen=[], connect=[at], mode="client")))
            continue
        listen = [] if name == RECORDER else [endpoint(host.listen or host.address, ports[name])]
        found.append(Placement(name, host, Endpoints(listen=listen, connect=list(earlier))))
        earlier.append(endpoint(host.address, ports[name]))
    return found


def _check(inventory: Inventory, source: str, processes: Sequence[str]) -> None:
    """Check the relations between hosts and processes."""
    known = [*processes, RECORDER, ROUTER]
    seen: dict[str, str] = {}
    names = [host.name for host in inventory.host]
    for i, host in enumerate(inventory.host, start=1):
        if names.count(host.name) > 1:
            raise InventoryError(f"{source}: host.{i}.name: expected each host once, got {host.name!r} again")
        for process in host.runs:
            if process not in known:
                near = difflib.get_close_matches(process, known, n=1)
                hint = f"; did you mean {near[0]!r}?" if near else ""
                raise InventoryError(
                    f"{source}: host.{i}.runs: expected one of {', '.join(known)}, got {process!r}{hint}"
                )
            if process in seen and process != ROUTER:
                raise InventoryError(f"{source}: host.{i}.runs: {process} runs on {seen[process]} already")
            seen[process] = host.name
        unknown = sorted(set(host.cpus) - set(host.runs))
        if unknown:
            raise InventoryError(f"{source}: host.{i}.cpus: expected one of {', '.join(host.runs)}, got {unknown[0]!r}")
        routers = [other.name for other in inventory.routers]
        if host.router is not None and host.router not in routers:
            expected = f"expected a host that runs a router ({', '.join(routers) or 'none does'})"
            raise InventoryError(f"{source}: host.{i}.router: {expected}, got {host.router!r}")
    missing = [process for process in processes if process not in seen]
    if missing:
        raise InventoryError(f"{source}: host: expected a host that runs {missing[0]}, got none")
