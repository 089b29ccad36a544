"""Inventory of hosts, the endpoints of their processes, and the folder of each host."""

import importlib.resources
import shlex
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
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

    Processes in the mesh's order.
    """
    base, routers, found = inventory.base_port, inventory.routers, []

    def endpoint(address: str, port: int) -> str:
        return f"{scheme}/[{address}]:{port}" if ":" in address else f"{scheme}/{address}:{port}"

    at = [endpoint(host.address, base) for host in routers]
    for i, host in enumerate(routers):
        listen = [endpoint(host.listen or host.address, base)]
        found.append(
            Placement(ROUTER, host, Endpoints(listen=listen, connect=at[:i], mode="router"))
        )
    earlier: list[str] = []  # endpoints of the processes before
    for port, name in enumerate([*processes, RECORDER], start=base):
        for host in (host for host in inventory.host if name in host.runs):
            if routers:  # its client: of the one named, its own, or the first
                own = [one for one in routers if one.name == (host.router or host.name)] or routers
                ends = Endpoints(listen=[], connect=[endpoint(own[0].address, base)], mode="client")
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
            yield (
                f"host.{i}.router",
                f"expected a host that runs a router, one of {routers}, got {host.router!r}",
            )
        for key, some, allowed in (("runs", host.runs, known), ("cpus", host.cpus, host.runs)):
            for process in some:
                if process not in allowed:
                    yield (
                        f"host.{i}.{key}",
                        f"expected one of {', '.join(allowed)}, got {process!r}",
                    )
    for process in [*processes, RECORDER]:
        if runs[process] > 1 or (runs[process] == 0 and process != RECORDER):
            yield "host", f"expected one host that runs {process}, got {runs[process]}"


# Paths on a host, as install.sh makes them; processes that are restarted, as they can rejoin the
# run.
ETC, PROGRAM, _RESTARTED = (
    Path("/etc/transport"),
    Path("/opt/transport/bin/transport"),
    ("agent", ROUTER),
)
_TEMPLATES = importlib.resources.files("transport.deploy") / "templates"


def render(
    setup: Setup, inventory: Inventory, keys: Path | None, out: Path, *, in_place: bool = False
) -> list[Path]:
    """Write the folders of all hosts with their keys into a new folder, to be used as /etc/transport or `in_place`."""
    if keys is None and not inventory.insecure:
        raise DeployError(
            "--keys: expected a folder of keys, or insecure = true in the inventory, got neither"
        )
    if out.exists():
        raise DeployError(f"--out: expected a folder that does not exist yet, got {out}")
    placed = placements(inventory, process_names(setup.scenario), "tcp" if keys is None else "tls")
    for host in inventory.host:
        folder = out / host.name
        _host(
            setup,
            inventory,
            [entry for entry in placed if entry.host == host],
            folder,
            in_place=in_place,
        )
        if keys is None:
            continue
        # Beside the coordinator are operator and watcher.
        holders = [*host.runs, *([OPERATOR, WATCHER] if COORDINATOR in host.runs else [])]
        (folder / "keys").mkdir(mode=0o700)
        for name in (
            AUTHORITY,
            *(f"{holder}.{end}" for holder in holders for end in ("pem", "key")),
        ):
            if not (keys / name).is_file():
                shutil.rmtree(out)
                raise DeployError(
                    f"--keys: expected the file {keys / name}, got none (transport deploy keys)"
                )
            shutil.copy(keys / name, folder / "keys" / name)
    return [out / host.name for host in inventory.host]


def unit(placement: Placement, inventory: Inventory, after: Sequence[str], etc: Path = ETC) -> str:
    """Return the systemd unit of a process, started after some of its host and stopped before them."""
    host, name = placement.host, placement.process
    scheduling = [f"CPUAffinity={' '.join(map(str, host.cpus[name]))}"] if name in host.cpus else []
    if host.priority:
        scheduling += ["CPUSchedulingPolicy=fifo", f"CPUSchedulingPriority={host.priority}"]
    return Template((_TEMPLATES / "process.service").read_text(encoding="utf-8")).substitute(
        name=name,
        run=inventory.run,
        after=" ".join(
            ["network-online.target", *[f"transport-{other}.service" for other in after]]
        ),
        environment="\n".join(f'Environment="{key}={value}"' for key, value in ENVIRONMENT.items()),
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
    host, ends, running = own[0].host, own[0].endpoints, [placement.process for placement in own]
    etc = folder.resolve() if in_place else ETC
    router = [
        placement.endpoints.connect[0] for placement in own if placement.endpoints.mode == "client"
    ]
    network: dict[str, Any] = {
        "host": host.listen or host.address,
        "base_port": inventory.base_port,
    }
    network |= {"router": router[0]} if router else {}
    is_secure = [*ends.listen, *ends.connect][0].startswith("tls")
    network |= {"keys": str(etc / "keys")} if is_secure else {"insecure": True}
    text = tomli_w.dumps({**setup.scenario.tree(), "network": network})
    (folder / "scenario.toml").write_text(text, encoding="utf-8")
    for placement in own:
        # Started last, the coordinator is stopped first, so that all processes on its host receive
        # the end of the run.
        after = (
            [other for other in running if other != COORDINATOR]
            if placement.process == COORDINATOR
            else []
        )
        file = folder / "systemd" / f"transport-{placement.process}.service"
        file.write_text(unit(placement, inventory, after, etc), encoding="utf-8")
    script = Template((_TEMPLATES / "install.sh").read_text(encoding="utf-8")).substitute(
        host=host.name,
        etc=ETC,
        program=PROGRAM,
        services=" ".join(f"transport-{name}.service" for name in running),
    )
    (folder / "install.sh").write_text(script, encoding="utf-8")
    (folder / "install.sh").chmod(0o755)
