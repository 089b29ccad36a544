"""The command `transport deploy keys`."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from protocol.network.endpoints import process_names
from protocol.wire.exit_codes import EXIT_USAGE
from protocol.wire.keys import ROUTER
from transport.cli.deploy.inventory import inventory_of, optional_packages
from transport.cli.options import FormatOption, ScenarioOption
from transport.cli.output import Format, exit_on, show_json
from transport.cli.scenario_setup import read_setup


def keys(
    out: Annotated[Path, Option("--out", metavar="FOLDER", help="Folder of the keys; existing keys are kept.")],
    scenario: ScenarioOption = "paper",
    hosts: Annotated[
        Path | None, Option("--hosts", metavar="FILE", help="Inventory of hosts (docs/deploy.md); default: this host.")
    ] = None,
    passwords: Annotated[bool, Option("--passwords", help="Passwords, for a router, instead of TLS.")] = False,
    days: Annotated[
        int, Option("--days", metavar="DAYS", min=1, max=3650, help="Validity of the certificates, days.")
    ] = 365,
    output: FormatOption = Format.text,
) -> None:
    """Create a certificate authority and process certificates.

    Example: transport deploy keys --out keys
    """
    setup = read_setup(scenario, None, allow_large=True)
    with optional_packages():
        from deploy.keys import LOOPBACK, OTHERS, KeysError, make_certificates, make_passwords
    names = [*process_names(setup.scenario), *OTHERS]
    addresses = {name: list(LOOPBACK) for name in names}
    if hosts is not None:
        inventory = inventory_of(hosts, setup)
        for host in inventory.host:
            for name in host.runs:
                addresses[name] = [*addresses[name], host.address]
        addresses[ROUTER] = [*LOOPBACK, *[host.address for host in inventory.routers]]
    with exit_on(KeysError, code=EXIT_USAGE):
        if passwords:
            make_passwords(out, names)
        else:
            make_certificates(out, addresses, days)
    if output is Format.json:
        show_json({"folder": str(out), "processes": names})
        return
    typer.echo(f"{out}: {'passwords' if passwords else 'certificates'} for {', '.join(names)}", err=True)
