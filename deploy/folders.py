"""Folder of each host: scenario, systemd units, keys, and the script that installs them."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import Any

import tomli_w

from transport.deploy.inventory import DeployError, Host, Inventory, check_links
from transport.deploy.placements import Placement, placements
from transport.deploy.units import ETC, PROGRAM, TEMPLATES, unit
from transport.protocol.network.mesh import process_names
from transport.protocol.network.security import AUTHORITY
from transport.protocol.scenario.files.atomic_writing import write_whole
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.key_expressions import OPERATOR, WATCHER
from transport.protocol.wire.names import COORDINATOR


def render(
    setup: Setup, inventory: Inventory, keys: Path | None, out: Path, *, in_place: bool = False
) -> list[Path]:
    """Write the folders of all hosts with their keys into a new folder, and return them.

    Scenario and units name the paths below /etc/transport, where `install.sh` puts the files. With
    `in_place` they point to where they were written (the lab).

    Raises: DeployError.
    """
    if keys is None and not inventory.insecure:
        expected = "expected a folder of keys, or insecure = true in the inventory, got neither"
        raise DeployError(f"--keys: {expected}")
    if out.exists():
        raise DeployError(f"--out: expected a folder that does not exist yet, got {out}")

    takes_over = setup.scenario.clock.on_coordinator_loss == "continue"
    if setup.scenario.has_vehicles:
        check_links(inventory, setup.scenario.vehicles.autopilot)

    scheme = "tcp" if keys is None else "tls"
    placed = placements(inventory, process_names(setup.scenario), scheme)
    for host in inventory.host:
        folder = out / host.name
        etc = folder.resolve() if in_place else ETC
        own = [placement for placement in placed if placement.host == host]

        folder.mkdir(parents=True)
        network = _network(inventory, own, None if keys is None else etc / "keys")
        text = tomli_w.dumps({**setup.scenario.tree(), "network": network})
        write_whole(folder / "scenario.toml", text)
        _write_units(inventory, own, folder / "systemd", etc, takes_over=takes_over)
        _write_install_script(own, folder / "install.sh")
        if keys is not None:
            _copy_keys(host, keys, out)
    return [out / host.name for host in inventory.host]


def _network(inventory: Inventory, own: Sequence[Placement], keys: Path | None) -> dict[str, Any]:
    """Return the section `network` of a host's scenario.

    `keys` is the folder of the keys as its processes find it, None without keys.
    """
    network: dict[str, Any] = {
        "host": own[0].host.listening_address,
        "base_port": inventory.base_port,
    }
    clients = [placement.endpoints for placement in own if placement.endpoints.mode == "client"]
    if clients:  # the processes of one host have the same router
        network["router"] = clients[0].connect[0]

    if keys is None:
        network["insecure"] = True
    else:
        network["keys"] = str(keys)
    return network


def _write_units(
    inventory: Inventory, own: Sequence[Placement], folder: Path, etc: Path, *, takes_over: bool
) -> None:
    """Write the units of a host's own processes into a new folder."""
    folder.mkdir()
    running = [placement.process for placement in own]
    for placement in own:
        # Started last, the coordinator is stopped first, so that all processes on its host receive
        # the end of the run.
        after = []
        if placement.process == COORDINATOR:
            after = [other for other in running if other != COORDINATOR]
        file = folder / f"transport-{placement.process}.service"
        write_whole(file, unit(placement, inventory, after, etc, takes_over=takes_over))


def _write_install_script(own: Sequence[Placement], file: Path) -> None:
    """Write the script that installs the folder of a host for its own processes."""
    template = Template((TEMPLATES / "install.sh").read_text(encoding="utf-8"))
    services = " ".join(f"transport-{placement.process}.service" for placement in own)
    script = template.substitute(host=own[0].host.name, etc=ETC, program=PROGRAM, services=services)
    write_whole(file, script)
    file.chmod(0o755)


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
