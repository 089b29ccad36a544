"""The command `transport metrics`."""

import threading
from collections.abc import Sequence
from typing import Annotated

import typer

from protocol.network.endpoints import Endpoints, default_mesh, process_names, security_of
from protocol.network.security import SecurityError
from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.schema import Scenario
from transport.cli.answers import fail

EXIT_USAGE, EXIT_SCENARIO = 2, 3


def metrics(
    scenario: Annotated[
        str, typer.Option("--scenario", help="Scenario file or name that the processes read.")
    ] = "paper",
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a scenario value. Repeatable.")
    ] = None,
    run: Annotated[str | None, typer.Option("--run", help="Name of the run; the scenario's by default.")] = None,
    connect: Annotated[
        list[str] | None, typer.Option("--connect", help="Endpoints of coordinator, plant, agent 1, ... in this order.")
    ] = None,
    port: Annotated[int, typer.Option("--port", min=1, max=65535, help="To serve on, at 127.0.0.1.")] = 9464,
) -> None:
    """Serve how the processes of a run are to Prometheus.

    Example: transport metrics --scenario resilient --port 9464
    """
    try:
        from prometheus_client import CollectorRegistry, start_http_server

        from transport.monitor.exporter import Exporter
    except ModuleNotFoundError as error:
        fail(f"expected the package {error.name}, got none: pip install 'payload-transport[metrics]'", EXIT_USAGE)
    try:
        path = find_scenario(scenario)
        read = read_scenario(path, settings or [])
        exporter = Exporter(run or read.name, asked_places(read, connect))
    except ScenarioError as error:
        fail(str(error.blaming(settings or [])), EXIT_SCENARIO)
    except SecurityError as error:
        fail(str(error), EXIT_SCENARIO)
    registry = CollectorRegistry()
    registry.register(exporter)
    try:
        server, thread = start_http_server(port, "127.0.0.1", registry)
    except OSError as error:
        fail(f"--port: cannot serve on {port} ({error.strerror})", EXIT_USAGE)
    typer.echo(f"http://127.0.0.1:{port}/metrics", err=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        server.shutdown()
        thread.join()


def asked_places(scenario: Scenario, connect: Sequence[str] | None = None) -> dict[str, Endpoints]:
    """Where each process of a scenario is asked.

    Args:
        scenario: The one they read.
        connect: Endpoints in place of the usual ones, in the order of the mesh.
    Raises: SecurityError: keys that cannot be used.
    """
    names = process_names(scenario)
    usual = default_mesh(scenario)
    if connect is not None and len(connect) != len(names):
        fail(f"--connect: expected {len(names)} endpoints, for {', '.join(names)}, got {len(connect)}", EXIT_USAGE)
    found = {}
    for i, name in enumerate(names):
        at = connect[i] if connect is not None else [*usual[name].listen, *usual[name].connect][0]
        found[name] = Endpoints(listen=[], connect=[at], mode=usual[name].mode, security=security_of(scenario))
    return found
