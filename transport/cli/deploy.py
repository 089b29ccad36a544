"""The commands `transport deploy`: keys and folders for a run on several hosts."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from deploy.hosts import Inventory, InventoryError, read_inventory
from protocol.network.endpoints import process_names
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_USAGE
from protocol.wire.keys import ROUTER
from transport.cli.options import FormatOption, LargeOption, ScenarioOption, SetOption
from transport.cli.output import Format, exit_on, fail, show_json
from transport.cli.scenario_setup import read_setup


def keys(
    out: Annotated[Path, Option("--out", metavar="FOLDER", help="Folder of the keys; existing keys are kept.")],
    scenario: ScenarioOption = "paper",
    hosts: Annotated[
        Path | None, Option("--hosts", metavar="FILE", help="Inventory of hosts (docs/deploy.md); default: this host.")
    ] = None,
    days: Annotated[
        int, Option("--days", metavar="DAYS", min=1, max=3650, help="Validity of the certificates, days.")
    ] = 365,
    output: FormatOption = Format.text,
) -> None:
    """Create a certificate authority and process certificates.

    Example: transport deploy keys --out keys
    """
    setup = read_setup(scenario, None, allow_large=True)
    with _optional_packages():
        from deploy.keys import LOOPBACK, OTHERS, KeysError, make_certificates
    names = [*process_names(setup.scenario), *OTHERS]
    addresses = {name: list(LOOPBACK) for name in names}
    if hosts is not None:
        inventory = _inventory_of(hosts, setup)
        for host in inventory.host:
            for name in host.runs:
                addresses[name] = [*addresses[name], host.address]
        addresses[ROUTER] = [*LOOPBACK, *[host.address for host in inventory.routers]]
    with exit_on(KeysError, code=EXIT_USAGE):
        make_certificates(out, addresses, days)
    if output is Format.json:
        show_json({"folder": str(out), "processes": names})
        return
    typer.echo(f"{out}: certificates for {', '.join(names)}", err=True)


def render(
    hosts: Annotated[
        Path, Option("--hosts", metavar="FILE", help="Inventory: the processes of each host (docs/deploy.md).")
    ],
    out: Annotated[Path, Option("--out", metavar="FOLDER", help="Folder to create, with one for each host.")],
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    keys: Annotated[
        Path | None, Option("--keys", metavar="FOLDER", help="Folder of keys (transport deploy keys).")
    ] = None,
    large: LargeOption = False,
    output: FormatOption = Format.text,
) -> None:
    """Write one deployment folder per host.

    Example: transport deploy render --hosts hosts.toml --keys keys --out deployment
    """
    setup = read_setup(scenario, settings, allow_large=large)
    inventory = _inventory_of(hosts, setup)
    with _optional_packages():
        from deploy.keys import KeysError
        from deploy.render import RenderError
        from deploy.render import render as render_folders
    try:
        with exit_on(RenderError, KeysError, code=EXIT_USAGE):
            folders = render_folders(setup, inventory, keys, out)
    except OSError as error:
        fail(f"--out: cannot write {error.filename or out} ({error.strerror})", EXIT_USAGE)
    if keys is None:
        typer.echo("warning: without keys, all who can reach these hosts can read and send every message", err=True)
    if output is Format.json:
        show_json({"folders": [str(folder) for folder in folders]})
        return
    for folder in folders:
        typer.echo(f" {folder}")


def _inventory_of(path: Path, setup: Setup) -> Inventory:
    """Read an inventory, or end the command if it is refused."""
    with exit_on(InventoryError, code=EXIT_USAGE):
        return read_inventory(path, process_names(setup.scenario))


@contextmanager
def _optional_packages() -> Iterator[None]:
    """End the command if an import fails, and name the extra to install."""
    try:
        yield
    except ModuleNotFoundError as error:
        fail(f"expected the package {error.name}, got none: pip install 'payload-transport[deploy]'", EXIT_USAGE)
