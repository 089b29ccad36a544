"""The command `transport deploy render`."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from protocol.wire.exit_codes import EXIT_USAGE
from transport.cli.deploy.inventory import inventory_of, optional_packages
from transport.cli.options import FormatOption, LargeOption, ScenarioOption, SetOption
from transport.cli.output import Format, exit_on, fail, show_json
from transport.cli.scenario_setup import read_setup


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
    inventory = inventory_of(hosts, setup)
    with optional_packages():
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
