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

from deploy.hosts import DeployError, Inventory, Placement, placements
from protocol.network.endpoints import process_names
from protocol.network.parent import ENVIRONMENT
from protocol.network.process import PATIENCE_S
from protocol.network.security import AUTHORITY, Security
from protocol.network.session import configuration
from protocol.scenario.setup import Setup
from protocol.wire.keys import OPERATOR, RECORDER, ROUTER, WATCHER, Keys
from protocol.wire.names import COORDINATOR

# Paths on a host, as install.sh makes them.
ETC, PROGRAM = Path("/etc/transport"), Path("/opt/transport/bin/transport")

# Processes restarted after a failure, because they can rejoin the run; the end of any other one ends the run.
_RESTARTED = ("agent", ROUTER)

_TEMPLATES = importlib.resources.files("deploy") / "templates"


def render(setup: Setup, inventory: Inventory, keys: Path | None, out: Path, *, in_place: bool = False) -> list[Path]:
    """Write the folders of all hosts, with the keys of their processes, into a new folder, and return them.

    With `in_place` they are used where they are, not as /etc/transport.

    Raises: DeployError: the folder exists, a key is missing, or hosts without keys would accept any connection.
    """
    if keys is None and not inventory.insecure:
        raise DeployError("--keys: expected a folder of keys, or insecure = true in the inventory, got neither")
    if out.exists():
        raise DeployError(f"--out: expected a folder that does not exist yet, got {out}")
    names = process_names(setup.scenario)
    placed = placements(inventory, names, "tcp" if keys is None else "tls")
    files: dict[str, list[Path]] = {host.name: [] for host in inventory.host}
    if keys is not None:
        security = Security(keys.resolve(), (*names, RECORDER))
        placed = [replace(entry, endpoints=replace(entry.endpoints, security=security)) for entry in placed]
        for host in inventory.host:
            # Beside the coordinator are operator and watcher.
            holders = [*host.runs, *([OPERATOR, WATCHER] if COORDINATOR in host.runs else [])]
            ends = [AUTHORITY, *(f"{name}.{end}" for name in holders for end in ("pem", "key"))]
            files[host.name] = [keys / end for end in ends]
        for file in (file for wanted in files.values() for file in wanted):
            if not file.is_file():
                raise DeployError(f"--keys: expected the file {file}, got none (transport deploy keys)")
    for host in inventory.host:
        folder = out / host.name
        etc, own = folder.resolve() if in_place else ETC, [entry for entry in placed if entry.host == host]
        _host(setup, inventory, own, folder, etc)
        if keys is not None:
            (folder / "keys").mkdir(mode=0o700)
        for file in files[host.name]:
            shutil.copy(file, folder / "keys" / file.name)
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
        after=" ".join(["network-online.target", *[f"transport-{other}.service" for other in after]]),
        environment="\n".join(f'Environment="{key}={value}"' for key, value in ENVIRONMENT.items()),
        command=shlex.join(command(placement, inventory, etc=etc)),
        restart="on-failure" if name.startswith(_RESTARTED) else "no",
        scheduling="\n".join(scheduling),
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
    line += [part for endpoint in placement.endpoints.listen for part in ("--listen", endpoint)]
    if placement.endpoints.mode != "client":  # otherwise the host's scenario names the router
        line += [part for endpoint in placement.endpoints.connect for part in ("--connect", endpoint)]
    if name == COORDINATOR and any(RECORDER in host.runs for host in inventory.host):
        line += ["--observer", RECORDER]
    return line


def _host(setup: Setup, inventory: Inventory, own: Sequence[Placement], folder: Path, etc: Path) -> None:
    """Write the folder of a host, which is `etc` there, with its own processes; but for the keys."""
    (folder / "systemd").mkdir(parents=True)
    host, security, running = own[0].host, own[0].endpoints.security, [placement.process for placement in own]
    router = next((placement.endpoints.connect[0] for placement in own if placement.endpoints.mode == "client"), None)
    network: dict[str, Any] = {"host": host.listen or host.address, "base_port": inventory.base_port}
    network |= {"router": router} if router else {}
    network |= {"keys": str(etc / "keys")} if security else {"insecure": True}
    text = tomli_w.dumps({**setup.scenario.tree(), "network": network})
    (folder / "scenario.toml").write_text(text, encoding="utf-8")
    (folder / "zenoh").mkdir(mode=0o700)
    for placement in own:
        name = placement.process
        # Started last, the coordinator is stopped first, so that all processes on its host receive the end of the run.
        after = [other for other in running if other != COORDINATOR] if name == COORDINATOR else []
        text = unit(placement, inventory, after, etc)
        (folder / "systemd" / f"transport-{name}.service").write_text(text, encoding="utf-8")
        # For other programs: zenohd as router, a foreign agent.
        prefix = Keys.below("transport/*") if name == ROUTER else Keys(inventory.run)
        found = configuration(placement.endpoints, PATIENCE_S[setup.scenario.clock.mode], name, prefix)
        text = json.dumps(found, indent=1, ensure_ascii=False)
        if security is not None:
            text = text.replace(str(security.folder), str(etc / "keys"))
        (folder / "zenoh" / f"{name}.json5").write_text(f"{text}\n", encoding="utf-8")
    script = Template((_TEMPLATES / "install.sh").read_text(encoding="utf-8")).substitute(
        host=host.name, etc=ETC, program=PROGRAM, services=" ".join(f"transport-{name}.service" for name in running)
    )
    (folder / "install.sh").write_text(script, encoding="utf-8")
    (folder / "install.sh").chmod(0o755)
