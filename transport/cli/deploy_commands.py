"""Commands that take a run to several hosts: keys, folders for each host, the router."""

import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_UNREACHABLE, EXIT_USAGE
from transport.cli.answers import fail, read_setup

if TYPE_CHECKING:
    from deploy.hosts import Inventory
    from protocol.scenario.setup import Setup


deploy_app = typer.Typer(help="Take a run to several hosts.", no_args_is_help=True, rich_markup_mode=None)

ScenarioOption = Annotated[str, typer.Option("--scenario", help="Scenario file or name; the same for all hosts.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a scenario value. Repeatable.")
]
HostsOption = Annotated[Path, typer.Option("--hosts", help="Inventory: which host runs what (docs/deploy.md).")]


@deploy_app.command("keys")
def deploy_keys(
    out: Annotated[Path, typer.Option("--out", help="Folder of the keys; those that are there stay.")],
    scenario: ScenarioOption = "paper",
    hosts: Annotated[
        Path | None, typer.Option("--hosts", help="Inventory; without one the keys are for this host alone.")
    ] = None,
    passwords: Annotated[bool, typer.Option("--passwords", help="Passwords, for a router, in place of TLS.")] = False,
    days: Annotated[int, typer.Option("--days", min=1, max=3650, help="How long certificates are good for.")] = 365,
) -> None:
    """Make an authority and a certificate for each process.

    Example: transport deploy keys --out keys
    """
    setup = read_setup(scenario, None)
    try:
        from deploy.keys import LOOPBACK, OTHERS, KeysError, make_certificates, make_passwords
    except ModuleNotFoundError as error:
        fail(f"expected the package {error.name}, got none: pip install 'payload-transport[deploy]'", EXIT_USAGE)
    from protocol.network.endpoints import process_names
    from protocol.wire.keys import ROUTER

    names = [*process_names(setup.scenario), *OTHERS]
    reached = {name: list(LOOPBACK) for name in names}
    if hosts is not None:
        inventory = _inventory(hosts, setup)
        for host in inventory.host:
            for name in host.runs:
                reached[name] = [*reached[name], host.address]
        reached[ROUTER] = [*LOOPBACK, *[host.address for host in inventory.routers]]
    try:
        if passwords:
            make_passwords(out, names)
        else:
            make_certificates(out, reached, days)
    except KeysError as error:
        fail(str(error), EXIT_USAGE)
    typer.echo(f"{out}: {'passwords' if passwords else 'certificates'} for {', '.join(names)}", err=True)


@deploy_app.command("render")
def deploy_render(
    hosts: HostsOption,
    out: Annotated[Path, typer.Option("--out", help="Folder to create, with one for each host.")],
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    keys: Annotated[Path | None, typer.Option("--keys", help="Folder of keys (transport deploy keys).")] = None,
) -> None:
    """Write a folder for each host, with all it needs.

    Example: transport deploy render --hosts hosts.toml --keys keys --out deployment
    """
    setup = read_setup(scenario, settings)
    inventory = _inventory(hosts, setup)
    try:
        from deploy.keys import KeysError
        from deploy.render import RenderError, render
    except ModuleNotFoundError as error:
        fail(f"expected the package {error.name}, got none: pip install 'payload-transport[deploy]'", EXIT_USAGE)

    try:
        folders = render(setup, inventory, keys, out)
    except (RenderError, KeysError) as error:
        fail(str(error), EXIT_USAGE)
    except OSError as error:
        fail(f"--out: cannot write {error.filename or out} ({error.strerror})", EXIT_USAGE)
    if keys is None:
        typer.echo("warning: without keys whoever reaches these hosts can read and say everything", err=True)
    for folder in folders:
        typer.echo(f" {folder}")


def router(
    listen: Annotated[list[str], typer.Option("--listen", help="Zenoh endpoint to listen on. Repeatable.")],
    connect: Annotated[list[str] | None, typer.Option("--connect", help="Endpoint of another router.")] = None,
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
) -> None:
    """Pass messages between hosts that do not reach each other.

    Serves any run until it is ended; who takes part and with which keys is the scenario's to say.

    Example: transport router --listen tcp/127.0.0.1:7400
    """
    import threading

    from protocol.network.endpoints import Endpoints, refuse_exposed, security_of
    from protocol.network.journal import Journal
    from protocol.network.security import SecurityError
    from protocol.network.session import BusError, route
    from protocol.wire.keys import ROUTER

    setup = read_setup(scenario, settings)
    security = security_of(setup.scenario)
    endpoints = Endpoints(listen=listen, connect=connect or [], mode="router", security=security)
    over = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: over.set())
    journal = Journal("any", ROUTER)
    try:
        refuse_exposed(endpoints, setup.scenario)
        if security is not None:
            security.check(ROUTER, mode="router")
        with route(endpoints):
            journal.log("listening", at=", ".join(listen))
            over.wait()
    except SecurityError as error:
        fail(str(error), EXIT_SCENARIO)
    except BusError as error:
        fail(str(error), EXIT_UNREACHABLE)
    journal.log("finished")


def _inventory(path: Path, setup: "Setup") -> "Inventory":
    from deploy.hosts import InventoryError, read_inventory
    from protocol.network.endpoints import process_names

    try:
        return read_inventory(path, process_names(setup.scenario))
    except InventoryError as error:
        fail(str(error), EXIT_USAGE)
