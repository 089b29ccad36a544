"""A folder for each host: scenario, services, keys and the script that puts them where they belong."""

import importlib.resources
import json
import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from string import Template
from typing import Any

import tomli_w

from deploy.hosts import Host, Inventory, Posting, postings
from deploy.keys import files_of
from protocol.network.endpoints import process_names
from protocol.network.parent import ENVIRONMENT
from protocol.network.process import PATIENCE_S
from protocol.network.security import AUTHORITY, Security
from protocol.network.session import configuration
from protocol.scenario.setup import Setup
from protocol.wire.keys import OPERATOR, RECORDER, ROUTER, WATCHER, Keys

# Where things are on a host, as install.sh puts them.
ETC, PROGRAM = Path("/etc/transport"), Path("/opt/transport/bin/transport")

# What decides a run for good is not started again by itself: an agent is, for it finds its way back.
_RESTARTED = ("agent", ROUTER)

_TEMPLATES = importlib.resources.files("deploy") / "templates"


class RenderError(ValueError):
    """A deployment that cannot be written: the text says what was expected and what came."""


def render(setup: Setup, inventory: Inventory, keys: Path | None, out: Path, *, in_place: bool = False) -> list[Path]:
    """Write the folders of all hosts.

    Args:
        setup: The run.
        inventory: Its hosts.
        keys: Folder of keys; each host gets those of what it runs. None only if the inventory says `insecure`.
        out: Folder to create.
        in_place: Whether the folders are used where they are, in place of /etc/transport.
    Returns: The folders.
    Raises: RenderError: the folder exists, or hosts without keys would be open to everybody.
        KeysError: a key is not there.
    """
    if keys is None and not inventory.insecure:
        raise RenderError("--keys: expected a folder of keys, or insecure = true in the inventory, got neither")
    if out.exists():
        raise RenderError(f"--out: expected a folder that does not exist yet, got {out}")
    scheme = "tls" if keys is not None and (keys / AUTHORITY).exists() else "tcp"
    if keys is not None and scheme == "tcp" and not inventory.routers:
        raise RenderError("--keys: expected a host that runs a router with passwords, which only a router can check")
    posted = postings(inventory, process_names(setup.scenario), scheme)
    wanted = {host.name: _keys(keys, host, posted) for host in inventory.host}
    for host in inventory.host:
        etc = (out / host.name).resolve() if in_place else ETC
        _host(setup, inventory, host, posted, wanted[host.name], keys, out / host.name, etc)
    return [out / host.name for host in inventory.host]


def unit(posting: Posting, inventory: Inventory, beside: Sequence[str], etc: Path = ETC) -> str:
    """The systemd unit of a process.

    Args:
        posting: Where it is.
        inventory: The deployment.
        beside: Processes of the same host that are to be there before it, and that it leaves before.
        etc: Where its scenario is.
    """
    host, name = posting.host, posting.process
    return Template((_TEMPLATES / "process.service").read_text(encoding="utf-8")).substitute(
        name=name,
        run=inventory.run,
        after=" ".join(["network-online.target", *[f"transport-{other}.service" for other in beside]]),
        environment="\n".join(f'Environment="{key}={value}"' for key, value in ENVIRONMENT.items()),
        command=shlex.join(command(posting, inventory, etc=etc)),
        restart="on-failure" if name.startswith(_RESTARTED) else "no",
        scheduling=_scheduling(host, name),
    )


def command(posting: Posting, inventory: Inventory, program: Path = PROGRAM, etc: Path = ETC) -> list[str]:
    """Command line of a process.

    Args:
        posting: Where it is.
        inventory: The deployment.
        program: The command `transport` of that host.
        etc: Where its scenario is.
    """
    name = posting.process
    role = ["agent", "--id", name.removeprefix("agent")] if name.startswith("agent") else [name]
    if name == RECORDER:
        role = ["record", "--no-figures"]
    words = [str(program), *role, "--scenario", str(etc / "scenario.toml")]
    words += [] if name == ROUTER else ["--run", inventory.run]
    for option, endpoints in (("--listen", posting.endpoints.listen), ("--connect", posting.endpoints.connect)):
        if option == "--connect" and posting.endpoints.mode == "client":
            continue  # the scenario of the host names the router
        for endpoint in endpoints:
            words += [option, endpoint]
    if name == "coordinator" and any(RECORDER in host.runs for host in inventory.host):
        words += ["--observer", RECORDER]
    return words


def _host(
    setup: Setup,
    inventory: Inventory,
    host: Host,
    posted: Sequence[Posting],
    keys: Sequence[Path],
    source: Path | None,
    folder: Path,
    etc: Path,
) -> None:
    own = [posting for posting in posted if posting.host == host]
    (folder / "systemd").mkdir(parents=True)
    router = next((posting.endpoints.connect[0] for posting in own if posting.endpoints.mode == "client"), None)
    tree = setup.scenario.tree()
    network: dict[str, Any] = {"host": host.listen or host.address, "base_port": inventory.base_port}
    network |= {"router": router} if router else {}
    network |= {"keys": str(etc / "keys")} if keys else {"insecure": True}
    (folder / "scenario.toml").write_text(tomli_w.dumps({**tree, "network": network}), encoding="utf-8")
    _write_samples(setup.samples_s, folder)
    running = [posting.process for posting in own]
    for posting in own:
        # Started last, the coordinator is stopped first: everybody hears of the end of the run while it is there.
        beside = [name for name in running if name != "coordinator"] if posting.process == "coordinator" else []
        text = unit(posting, inventory, beside, etc)
        (folder / "systemd" / f"transport-{posting.process}.service").write_text(text, encoding="utf-8")
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
    setup: Setup, inventory: Inventory, own: Sequence[Posting], source: Path | None, folder: Path, etc: Path
) -> None:
    """Zenoh's configuration of each process, for those that are not ours: a zenohd as router, an agent of one's own."""
    (folder / "zenoh").mkdir(mode=0o700)
    names = (*process_names(setup.scenario), RECORDER)
    security = None if source is None else Security(source.resolve(), names)
    patience_s = PATIENCE_S[setup.scenario.clock.mode]
    for posting in own:
        name, place = posting.process, replace(posting.endpoints, security=security)
        keys = Keys.below("transport/*") if name == ROUTER else Keys(inventory.run)
        text = json.dumps(configuration(place, patience_s, name, keys), indent=1)
        if source is not None:
            text = text.replace(str(source.resolve()), str(etc / "keys"))
        file = folder / "zenoh" / f"{name}.json5"
        file.touch(mode=0o600)  # there may be a password in it
        file.write_text(f"{text}\n", encoding="utf-8")


def _write_samples(samples_s: Mapping[str, Sequence[float]], folder: Path) -> None:
    """Files of measured delays that the scenario names."""
    for name, delays_s in samples_s.items():
        if not Path(name).is_absolute():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text("\n".join(map(repr, delays_s)) + "\n", encoding="utf-8")


def _keys(keys: Path | None, host: Host, posted: Sequence[Posting]) -> list[Path]:
    """Keys a host needs: of what it runs, and where the coordinator is, of those who ask and look on."""
    if keys is None:
        return []
    names = [posting.process for posting in posted if posting.host == host]
    names += [OPERATOR, WATCHER] if "coordinator" in names else []
    return list(dict.fromkeys(file for name in names for file in files_of(keys, name)))


def _scheduling(host: Host, name: str) -> str:
    lines = []
    if name in host.cpus:
        lines.append(f"CPUAffinity={' '.join(map(str, host.cpus[name]))}")
    if host.priority:
        lines += ["CPUSchedulingPolicy=fifo", f"CPUSchedulingPriority={host.priority}"]
    return "\n".join(lines)
