"""Commands `transport deploy`: keys and folders for a run on several hosts."""

from pathlib import Path

import typer
from typer import Option

from transport.cli.options import FormatOption, LargeOption, ScenarioOption, SetOption, read_setup
from transport.cli.output import Format, show
from transport.deploy.inventory import read_inventory
from transport.protocol.network.mesh import process_names
from transport.protocol.wire.key_expressions import ROUTER


def keys(
    out: Path = Option(..., metavar="FOLDER", help="Folder of the keys; existing keys are kept."),
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    hosts: Path | None = Option(
        None, metavar="FILE", help="Inventory of hosts (docs/deploy.md); default: this host."
    ),
    days: int = Option(
        365, metavar="DAYS", min=1, max=3650, help="Validity of the certificates, days."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Create a certificate authority and process certificates.

    Example: transport deploy keys --out keys
    """
    from transport.deploy.certificates import LOOPBACK, OTHERS, make_certificates

    processes = process_names(read_setup(scenario, settings, allow_large=True).scenario)
    names = [*processes, *OTHERS]
    addresses = {name: list(LOOPBACK) for name in names}

    if hosts is not None:
        inventory = read_inventory(hosts, processes)
        for host in inventory.host:
            for name in host.runs:
                addresses[name].append(host.address)
        addresses[ROUTER] = [*LOOPBACK, *[host.address for host in inventory.routers]]

    make_certificates(out, addresses, days)
    show(output, {"folder": str(out), "processes": names})
    if output is Format.text:
        typer.echo(f"{out}: certificates for {', '.join(names)}", err=True)


def render(
    hosts: Path = Option(
        ..., metavar="FILE", help="Inventory: the processes of each host (docs/deploy.md)."
    ),
    out: Path = Option(..., metavar="FOLDER", help="Folder to create, with one for each host."),
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    keys: Path | None = Option(
        None, metavar="FOLDER", help="Folder of keys (transport deploy keys)."
    ),
    large: LargeOption = False,
    output: FormatOption = Format.text,
) -> None:
    """Write one deployment folder per host.

    Example: transport deploy render --hosts hosts.toml --keys keys --out deployment
    """
    from transport.deploy.folders import render as render_folders

    setup = read_setup(scenario, settings, allow_large=large)
    inventory = read_inventory(hosts, process_names(setup.scenario))
    folders = [str(folder) for folder in render_folders(setup, inventory, keys, out)]

    if keys is None:
        risk = "all who can reach these hosts can read and send every message"
        typer.echo(f"warning: without keys, {risk}", err=True)
    show(output, {"folders": folders}, *(f" {folder}" for folder in folders))
