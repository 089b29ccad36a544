"""Inventory of hosts, each with the processes that it runs."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field

from transport.model.section import Section
from transport.protocol.network.endpoints import DEFAULT_BASE_PORT
from transport.protocol.scenario.scenario_file import read_tree
from transport.protocol.scenario.sections.scenario_errors import ScenarioError, validated
from transport.protocol.wire.errors_and_exit_codes import TransportError
from transport.protocol.wire.key_expressions import RECORDER, ROUTER
from transport.protocol.wire.names import VEHICLE, role_of

Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,40}$")]
Address = Annotated[str, Field(pattern=r"^[A-Za-z0-9.:_-]{1,253}$")]


class DeployError(TransportError, ValueError):
    """An inventory, keys or folders that cannot be used.

    The text has file or option, expected and got.
    """


_LINK = r"^((udp|udpclient|tcp):\S+:\d+|serial:\S+)$"


class Host(Section):
    """One host of a deployment."""

    name: Name
    """name of the host, and of its folder"""
    address: Address
    """address at which the other hosts reach it"""
    runs: Annotated[list[Name], Field(min_length=1)]
    """its processes: coordinator, plant, agent1, ..., vehicle1, ..., recorder, router"""
    autopilot: Annotated[str, Field(pattern=_LINK)] | None = None
    """MAVLink of its vehicle's autopilot, or MSP of a Betaflight, as of `transport vehicle --link`; if
    omitted port 14549 plus the number of the UAV, at 127.0.0.1"""
    pose: Annotated[str, Field(pattern=r"^udp(client)?:\S+:\d+$")] | None = None
    """motion capture of its Betaflight, as of `transport vehicle --pose`"""
    key: Annotated[str, Field(pattern=r"^/\S+$")] | None = None
    """file on this host with the key of MAVLink signing of its vehicle, as of `transport vehicle --key`;
    the user `transport` reads it"""
    stands: bool = False
    """its vehicle stands until tick 0, as with `transport vehicle --stands`"""
    listen: Address | None = None
    """address to listen on, if it is not `address` (in a container 0.0.0.0)"""
    router: Name | None = None
    """host whose router its processes connect to; if omitted: itself, else the first with one"""
    cpus: dict[Name, list[Annotated[int, Field(ge=0, le=4095)]]] = {}
    """processors by process; all for a process that is not named"""
    priority: Annotated[int, Field(ge=0, le=50)] = 0
    """SCHED_FIFO priority of its processes, 0 for none"""

    @property
    def listening_address(self) -> str:
        """Address that its processes listen on."""
        return self.listen or self.address


class Inventory(Section):
    """A deployment; docs/deploy.md describes each key."""

    run: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,80}$")]
    """name of the run"""
    base_port: Annotated[int, Field(ge=1024, le=65_000)] = DEFAULT_BASE_PORT
    """port of the coordinator, or of every router"""
    insecure: bool = False
    """deploy without keys"""
    host: Annotated[list[Host], Field(min_length=1)]
    """the hosts"""

    @property
    def routers(self) -> list[Host]:
        """Hosts that run a router, in order."""
        return self.hosts_of(ROUTER)

    def hosts_of(self, process: str) -> list[Host]:
        """Return the hosts that run a process, in order.

        In an inventory that was read each process has exactly one host. Only the recorder may have
        none, and the router any number, so callers loop over the hosts.
        """
        return [host for host in self.host if process in host.runs]


def check_links(inventory: Inventory, autopilot: str) -> None:
    """Check that the link of each vehicle is one of its autopilot. Raises: DeployError."""
    is_betaflight = autopilot == "betaflight"
    for i, host in enumerate(inventory.host, start=1):
        link = host.autopilot or ""
        if link.startswith(("serial:", "tcp:")) and not is_betaflight:
            expected = f"expected udp:HOST:PORT or udpclient:HOST:PORT with {autopilot}"
            remedy = "mavlink-routerd joins a serial port to one"
            raise DeployError(f"host.{i}.autopilot: {expected}, got {link!r}; {remedy}")
        vehicles = [name for name in host.runs if role_of(name) == VEHICLE]
        if vehicles and is_betaflight and host.pose is None:
            raise DeployError(
                f"host.{i}.pose: expected the motion capture of a Betaflight, got none"
            )


def read_inventory(path: Path, processes: Sequence[str]) -> Inventory:
    """Read an inventory, with each process on one host.

    Raises: DeployError: naming file, field, expected and got.
    """
    try:
        inventory = validated(Inventory, read_tree(path), str(path))
    except ScenarioError as error:
        raise DeployError(str(error)) from error
    for field, problem in _problems(inventory, processes):
        raise DeployError(f"{path}: {field}: {problem}")
    return inventory


def _problems(inventory: Inventory, processes: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield field, and expected and got, of hosts and processes that do not fit."""
    allowed = [*processes, RECORDER, ROUTER]
    names = [host.name for host in inventory.host]
    routers = [host.name for host in inventory.routers]
    for i, host in enumerate(inventory.host, start=1):
        if host.name in names[: i - 1]:
            yield f"host.{i}.name", f"expected each host once, got {host.name!r} again"
        if host.router is not None and host.router not in routers:
            expected = f"expected a host that runs a router, one of {routers}"
            yield f"host.{i}.router", f"{expected}, got {host.router!r}"
        yield from _strangers(f"host.{i}.runs", host.runs, allowed)
        twice = [process for process, times in Counter(host.runs).items() if times > 1]
        if twice:
            yield f"host.{i}.runs", f"expected each process once, got {twice[0]!r} again"
        yield from _strangers(f"host.{i}.cpus", host.cpus, host.runs)

    for process in [*processes, RECORDER]:
        count = len(inventory.hosts_of(process))
        is_missing = count == 0 and process != RECORDER
        if count > 1 or is_missing:
            yield "host", f"expected one host that runs {process}, got {count}"


def _strangers(
    field: str, processes: Iterable[str], allowed: Sequence[str]
) -> Iterator[tuple[str, str]]:
    """Yield a problem for each process that is not among the allowed ones."""
    for process in processes:
        if process not in allowed:
            yield field, f"expected one of {', '.join(allowed)}, got {process!r}"
