"""Deployment folders: scenario, services, keys and installation script of each host."""

import importlib.resources
import json
import shlex
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from string import Template
from typing import Any

import tomli_w

from deploy.hosts import Host, Inventory, Placement, placements
from deploy.keys import files_of
from protocol.network.endpoints import process_names
from protocol.network.parent import ENVIRONMENT
from protocol.network.process import PATIENCE_S
from protocol.network.security import AUTHORITY, Security
from protocol.network.session import configuration
from protocol.scenario.files import write_delays
from protocol.scenario.setup import Setup
from protocol.wire.errors import TransportError
from protocol.wire.keys import OPERATOR, RECORDER, ROUTER, WATCHER, Keys
from protocol.wire.names import COORDINATOR

# Paths on a host, as install.sh makes them.
ETC, PROGRAM = Path("/etc/transport"), Path("/opt/transport/bin/transport")

# Processes restarted after a failure, because they can rejoin the run; the end of any other one ends the run.
_RESTARTED = ("agent", ROUTER)

_TEMPLATES = importlib.resources.files("deploy") / "templates"


class RenderError(TransportError, ValueError):
    """A deployment that cannot be written; the text has expected and got."""


def render(setup: Setup, inventory: Inventory, keys: Path | None, out: Path, *, in_place: bool = False) -> list[Path]:
    """Write the folders of all hosts into a new folder, and return them.

    Each host gets the keys of its processes; only an `insecure` inventory has none. With `in_place` the folders are
    used where they are, not as /etc/transport.

    Raises: RenderError: the folder exists, or hosts without keys would accept any connection.
        KeysError: a key is missing.
    """
    if keys is None and not inventory.insecure:
        raise RenderError("--keys: expected a folder of keys, or insecure = true in the inventory, got neither")
    if out.exists():
        raise RenderError(f"--out: expected a folder that does not exist yet, got {out}")
    scheme = "tls" if keys is not None and (keys / AUTHORITY).exists() else "tcp"
    if keys is not None and scheme == "tcp" and not inventory.routers:
        raise RenderError("--keys: expected a host that runs a router with passwords, which only a router can check")
    placed = placements(inventory, process_names(setup.scenario), scheme)
    wanted = {host.name: _keys(keys, host, placed) for host in inventory.host}
    for host in inventory.host:
        etc = (out / host.name).resolve() if in_place else ETC
        _host(setup, inventory, host, placed, wanted[host.name], keys, out / host.name, etc)
    return [out / host.name for host in inventory.host]


def unit(placement: Placement, inventory: Inventory, after: Sequence[str], etc: Path = ETC) -> str:
    """Return the systemd unit of a process, started after some of its host and stopped before them.

    `etc` is the folder of its scenario.
    """
    host, name = placement.host, placement.process
    return Template((_TEMPLATES / "process.service").read_text(encoding="utf-8")).substitute(
        name=name,
        run=inventory.run,
        after=" ".join(["network-online.target", *[f"transport-{other}.service" for other in after]]),
        environment="\n".join(f'Environment="{key}={value}"' for key, value in ENVIRONMENT.items()),
        command=shlex.join(command(placement, inventory, etc=etc)),
        restart="on-failure" if name.startswith(_RESTARTED) else "no",
        scheduling=_scheduling(host, name),
    )


def command(placement: Placement, inventory: Inventory, program: Path = PROGRAM, etc: Path = ETC) -> list[str]:
    """Return the command line of a process; `program` is `transport` on its host, `etc` the folder of its scenario."""
    name = placement.process
    role = ["agent", "--id", name.removeprefix("agent")] if name.startswith("agent") else [name]
    if name == RECORDER:
        role = ["record", "--no-figures"]
    line = [str(program), *role, "--scenario", str(etc / "scenario.toml")]
    # The size of the run is checked when its folders are rendered.
    line += [] if name == ROUTER else ["--allow-large", "--run", inventory.run]
    for option, endpoints in (("--listen", placement.endpoints.listen), ("--connect", placement.endpoints.connect)):
        if option == "--connect" and placement.endpoints.mode == "client":
            continue  # the host's scenario names the router
        for endpoint in endpoints:
            line += [option, endpoint]
    if name == COORDINATOR and any(RECORDER in host.runs for host in inventory.host):
        line += ["--observer", RECORDER]
    return line


def _host(
    setup: Setup,
    inventory: Inventory,
    host: Host,
    placed: Sequence[Placement],
    keys: Sequence[Path],
    source: Path | None,
    folder: Path,
    etc: Path,
) -> None:
    own = [placement for placement in placed if placement.host == host]
    (folder / "systemd").mkdir(parents=True)
    router = next((placement.endpoints.connect[0] for placement in own if placement.endpoints.mode == "client"), None)
    tree = setup.scenario.tree()
    network: dict[str, Any] = {"host": host.listen or host.address, "base_port": inventory.base_port}
    network |= {"router": router} if router else {}
    network |= {"keys": str(etc / "keys")} if keys else {"insecure": True}
    (folder / "scenario.toml").write_text(tomli_w.dumps({**tree, "network": network}), encoding="utf-8")
    write_delays(setup.samples_s, folder)
    running = [placement.process for placement in own]
    for placement in own:
        # Started last, the coordinator is stopped first, so that all processes on its host receive the end of the run.
        after = [name for name in running if name != COORDINATOR] if placement.process == COORDINATOR else []
        text = unit(placement, inventory, after, etc)
        (folder / "systemd" / f"transport-{placement.process}.service").write_text(text, encoding="utf-8")
    _write_configurations(setup, inventory, own, source, folder, etc)
    if keys:
        (folder / "keys").mkdir(mode=0o700)
        for file in keys:
            shutil.copy(file, folder / "keys" / file.name)
    services = " ".join(f"transport-{name}.service" for name in running)
    script = Template((_TEMPLATES / "install.sh").read_text(encoding="utf-8"))
    (folder / "install.sh").write_text(
        script.substitute(host=host.name, etc=ETC, program=PROGRAM, services=services), encoding="utf-8"
    )
    (folder / "install.sh").chmod(0o755)


def _write_configurations(
    setup: Setup, inventory: Inventory, own: Sequence[Placement], source: Path | None, folder: Path, etc: Path
) -> None:
    """Write Zenoh's configuration of each process, for other programs: zenohd as router, a foreign agent."""
    (folder / "zenoh").mkdir(mode=0o700)
    names = (*process_names(setup.scenario), RECORDER)
    security = None if source is None else Security(source.resolve(), names)
    patience_s = PATIENCE_S[setup.scenario.clock.mode]
    for placement in own:
        name, place = placement.process, replace(placement.endpoints, security=security)
        keys = Keys.below("transport/*") if name == ROUTER else Keys(inventory.run)
        text = json.dumps(configuration(place, patience_s, name, keys), indent=1, ensure_ascii=False)
        if source is not None:
            text = text.replace(str(source.resolve()), str(etc / "keys"))
        file = folder / "zenoh" / f"{name}.json5"
        file.touch(mode=0o600)  # it may contain a password
        file.write_text(f"{text}\n", encoding="utf-8")


def _keys(keys: Path | None, host: Host, placed: Sequence[Placement]) -> list[Path]:
    """Return the key files of a host: of its processes, and beside the coordinator of operator and watcher."""
    if keys is None:
        return []
    names = [placement.process for placement in placed if placement.host == host]
    names += [OPERATOR, WATCHER] if COORDINATOR in names else []
    return list(dict.fromkeys(file for name in names for file in files_of(keys, name)))


def _scheduling(host: Host, name: str) -> str:
    lines = []
    if name in host.cpus:
        lines.append(f"CPUAffinity={' '.join(map(str, host.cpus[name]))}")
    if host.priority:
        lines += ["CPUSchedulingPolicy=fifo", f"CPUSchedulingPriority={host.priority}"]
    return "\n".join(lines)
