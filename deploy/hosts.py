"""Inventory of hosts, the endpoints of their processes, and the folder of each host."""

import importlib.resources
import shlex
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Annotated, Any

import tomli_w
from pydantic import Field

from transport.mpc.settings import Section
from transport.protocol.network.endpoints import DEFAULT_BASE_PORT, Endpoints, process_names
from transport.protocol.network.parent import ENVIRONMENT
from transport.protocol.network.security import AUTHORITY
from transport.protocol.scenario.errors import ScenarioError, validated
from transport.protocol.scenario.file import read_tree
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.errors import TransportError
from transport.protocol.wire.keys import OPERATOR, RECORDER, ROUTER, WATCHER
from transport.protocol.wire.names import COORDINATOR


class DeployError(TransportError, ValueError):
    """An inventory, keys or folders that cannot be used.

    The text has file or option, expected and got.
    """


Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,40}$")]
Address = Annotated[str, Field(pattern=r"^[A-Za-z0-9.:_-]{1,253}$")]


class Host(Section):
    """One host."""

    name: Name  # of its folder
    address: Address  # that the other hosts connect to
    runs: Annotated[
        list[Name], Field(min_length=1)
    ]  # processes: coordinator, plant, agent1, ..., recorder, router
    listen: Address | None = None  # if it is not `address` (in a container 0.0.0.0)
    router: Name | None = None  # host whose router its processes connect to
    cpus: dict[Name, list[Annotated[int, Field(ge=0, le=4095)]]] = {}  # processors by process
    priority: Annotated[int, Field(ge=0, le=50)] = (
        0  # SCHED_FIFO priority of its processes, 0 for none
    )


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
        listen = [_endpoint(scheme, host.listen or host.address, port)]
        endpoints = Endpoints(listen=listen, connect=places[:i], mode="router")
        routers.append(Placement(ROUTER, host, endpoints))
    return routers


def _clients(inventory: Inventory, processes: Sequence[str], scheme: str) -> list[Placement]:
    """Return the placements of clients of a router: named, of their host, or the first."""
    clients = []
    for name in [*processes, RECORDER]:
        for host in _hosts_of(inventory, name):
            wanted = host.router or host.name
            own = [each for each in inventory.routers if each.name == wanted]
            router = (own or inventory.routers)[0]
            place = _endpoint(scheme, router.address, inventory.base_port)
            endpoints = Endpoints(listen=[], connect=[place], mode="client")
            clients.append(Placement(name, host, endpoints))
    return clients


def _peers(inventory: Inventory, processes: Sequence[str], scheme: str) -> list[Placement]:
    """Return the placements of peers, each connected to those before."""
    peers = []
    earlier: list[str] = []
    for port, name in enumerate([*processes, RECORDER], start=inventory.base_port):
        for host in _hosts_of(inventory, name):
            listen = []
            if name != RECORDER:
                listen = [_endpoint(scheme, host.listen or host.address, port)]
            endpoints = Endpoints(listen=listen, connect=list(earlier))
            peers.append(Placement(name, host, endpoints))
            earlier.append(_endpoint(scheme, host.address, port))
    return peers


def _hosts_of(inventory: Inventory, process: str) -> list[Host]:
    """Return the hosts that run a process."""
    return [host for host in inventory.host if process in host.runs]


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

    runs = Counter(process for host in inventory.host for process in host.runs)
    for process in [*processes, RECORDER]:
        is_missing = runs[process] == 0 and process != RECORDER
        if runs[process] > 1 or is_missing:
            yield "host", f"expected one host that runs {process}, got {runs[process]}"


def _strangers(
    field: str, processes: Iterable[str], allowed: Sequence[str]
) -> Iterator[tuple[str, str]]:
    """Yield a problem for each process that is not among the allowed ones."""
    for process in processes:
        if process not in allowed:
            yield field, f"expected one of {', '.join(allowed)}, got {process!r}"


# Paths on a host, as install.sh makes them.
ETC = Path("/etc/transport")
PROGRAM = Path("/opt/transport/bin/transport")
# Processes that are restarted, as they can rejoin the run.
_RESTARTED = ("agent", ROUTER)
_TEMPLATES = importlib.resources.files("transport.deploy") / "templates"


def render(
    setup: Setup, inventory: Inventory, keys: Path | None, out: Path, *, in_place: bool = False
) -> list[Path]:
    """Write the folders of all hosts with their keys into a new folder, and return them.

    They are to be used as /etc/transport or `in_place`. Raises: DeployError.
    """
    if keys is None and not inventory.insecure:
        expected = "expected a folder of keys, or insecure = true in the inventory, got neither"
        raise DeployError(f"--keys: {expected}")
    if out.exists():
        raise DeployError(f"--out: expected a folder that does not exist yet, got {out}")

    scheme = "tcp" if keys is None else "tls"
    placed = placements(inventory, process_names(setup.scenario), scheme)
    for host in inventory.host:
        own = [placement for placement in placed if placement.host == host]
        _host(setup, inventory, own, out / host.name, in_place=in_place)
        if keys is not None:
            _copy_keys(host, keys, out)
    return [out / host.name for host in inventory.host]


def _copy_keys(host: Host, keys: Path, out: Path) -> None:
    """Copy the keys of a host's processes to its folder; without one of them nothing is left."""
    holders = [*host.runs]
    if COORDINATOR in host.runs:
        holders += [OPERATOR, WATCHER]  # they are beside the coordinator
    names = [AUTHORITY, *(f"{holder}.{end}" for holder in holders for end in ("pem", "key"))]

    folder = out / host.name / "keys"
    folder.mkdir(mode=0o700)
    for name in names:
        if not (keys / name).is_file():
            shutil.rmtree(out)
            expected = f"expected the file {keys / name}, got none (transport deploy keys)"
            raise DeployError(f"--keys: {expected}")
        shutil.copy(keys / name, folder / name)


def unit(placement: Placement, inventory: Inventory, after: Sequence[str], etc: Path = ETC) -> str:
    """Return the systemd unit of a process, started after some of its host, stopped before them."""
    host = placement.host
    name = placement.process
    scheduling = []
    if name in host.cpus:
        scheduling.append(f"CPUAffinity={' '.join(map(str, host.cpus[name]))}")
    if host.priority:
        scheduling += ["CPUSchedulingPolicy=fifo", f"CPUSchedulingPriority={host.priority}"]

    others = [f"transport-{other}.service" for other in after]
    environment = [f'Environment="{key}={value}"' for key, value in ENVIRONMENT.items()]
    template = Template((_TEMPLATES / "process.service").read_text(encoding="utf-8"))
    return template.substitute(
        name=name,
        run=inventory.run,
        after=" ".join(["network-online.target", *others]),
        environment="\n".join(environment),
        command=shlex.join(command(placement, inventory, etc=etc)),
        restart="on-failure" if name.startswith(_RESTARTED) else "no",
        scheduling="\n".join(scheduling),
    )


def command(
    placement: Placement, inventory: Inventory, program: Path = PROGRAM, etc: Path = ETC
) -> list[str]:
    """Return the command line of a process.

    `program` is `transport` on its host, `etc` the folder of its scenario.
    """
    name = placement.process
    role = ["agent", "--id", name.removeprefix("agent")] if name.startswith("agent") else [name]
    if name == RECORDER:
        role = ["record", "--no-figures"]
    line = [str(program), *role, "--scenario", str(etc / "scenario.toml")]
    # The size of the run is checked when its folders are rendered.
    line += [] if name == ROUTER else ["--allow-large", "--run", inventory.run]
    line += [part for endpoint in placement.endpoints.listen for part in ("--listen", endpoint)]
    if placement.endpoints.mode != "client":  # otherwise the host's scenario names the router
        line += [
            part for endpoint in placement.endpoints.connect for part in ("--connect", endpoint)
        ]
    if name == COORDINATOR and any(RECORDER in host.runs for host in inventory.host):
        line += ["--observer", RECORDER]
    return line


def _host(
    setup: Setup, inventory: Inventory, own: Sequence[Placement], folder: Path, *, in_place: bool
) -> None:
    """Write the folder of a host with its own processes, but for the keys."""
    (folder / "systemd").mkdir(parents=True)
    etc = folder.resolve() if in_place else ETC
    network = _network(inventory, own, etc)
    text = tomli_w.dumps({**setup.scenario.tree(), "network": network})
    (folder / "scenario.toml").write_text(text, encoding="utf-8")

    running = [placement.process for placement in own]
    for placement in own:
        # Started last, the coordinator is stopped first, so that all processes on its host receive
        # the end of the run.
        after = []
        if placement.process == COORDINATOR:
            after = [other for other in running if other != COORDINATOR]
        file = folder / "systemd" / f"transport-{placement.process}.service"
        file.write_text(unit(placement, inventory, after, etc), encoding="utf-8")

    template = Template((_TEMPLATES / "install.sh").read_text(encoding="utf-8"))
    services = " ".join(f"transport-{name}.service" for name in running)
    script = template.substitute(host=own[0].host.name, etc=ETC, program=PROGRAM, services=services)
    (folder / "install.sh").write_text(script, encoding="utf-8")
    (folder / "install.sh").chmod(0o755)


def _network(inventory: Inventory, own: Sequence[Placement], etc: Path) -> dict[str, Any]:
    """Return the section `network` of a host's scenario."""
    host = own[0].host
    network: dict[str, Any] = {
        "host": host.listen or host.address,
        "base_port": inventory.base_port,
    }
    clients = [placement.endpoints for placement in own if placement.endpoints.mode == "client"]
    if clients:
        network["router"] = clients[0].connect[0]

    first = [*own[0].endpoints.listen, *own[0].endpoints.connect][0]
    if first.startswith("tls"):
        network["keys"] = str(etc / "keys")
    else:
        network["insecure"] = True
    return network
