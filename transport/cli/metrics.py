"""The command `transport metrics`."""

import sys
import threading
from collections.abc import Sequence
from typing import Annotated

import typer
from typer import Option

from protocol.network.endpoints import Endpoints, default_mesh, process_names, security_of
from protocol.network.security import SecurityError
from protocol.scenario.schema import Scenario
from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_USAGE
from transport.cli.options import FormatOption, ScenarioOption, SetOption
from transport.cli.output import Format, exit_on, fail, show_json
from transport.cli.scenario_setup import read_setup


def metrics(
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    run: Annotated[
        str | None, Option("--run", metavar="NAME", help="Name of the run; the scenario's by default.")
    ] = None,
    connect: Annotated[
        list[str] | None,
        Option("--connect", metavar="ENDPOINT", help="Endpoints of coordinator, plant, agent 1, ... in this order."),
    ] = None,
    port: Annotated[
        int, Option("--port", metavar="PORT", min=1, max=65535, help="Port to serve on, at 127.0.0.1.")
    ] = 9464,
    output: FormatOption = Format.text,
) -> None:
    """Export process metrics to Prometheus.

    Example: transport metrics --scenario resilient --port 9464
    """
    try:
        from prometheus_client import CollectorRegistry, start_http_server

        from transport.monitor.exporter import Exporter
    except ModuleNotFoundError as error:
        fail(f"expected the package {error.name}, got none: pip install 'payload-transport[metrics]'", EXIT_USAGE)
    described = read_setup(scenario, settings, allow_large=True).scenario
    registry = CollectorRegistry()
    with exit_on(SecurityError, code=EXIT_SCENARIO):
        registry.register(Exporter(run or described.name, process_endpoints(described, connect)))
    try:
        server, thread = start_http_server(port, "127.0.0.1", registry)
    except OSError as error:
        fail(f"--port: cannot serve on {port} ({error.strerror})", EXIT_USAGE)
    address = f"http://127.0.0.1:{port}/metrics"
    if output is Format.json:
        show_json({"address": address})
        sys.stdout.flush()
    else:
        typer.echo(address, err=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        server.shutdown()
        thread.join()


def process_endpoints(scenario: Scenario, connect: Sequence[str] | None = None) -> dict[str, Endpoints]:
    """Return the endpoints at which to ask each process of a scenario, by name.

    Given endpoints, in the order of the mesh, replace the default ones.

    Raises: SecurityError: the keys cannot be used.
    """
    names = process_names(scenario)
    default = default_mesh(scenario)
    if connect is not None and len(connect) != len(names):
        fail(f"--connect: expected {len(names)} endpoints, for {', '.join(names)}, got {len(connect)}", EXIT_USAGE)
    found = {}
    for i, name in enumerate(names):
        at = connect[i] if connect is not None else [*default[name].listen, *default[name].connect][0]
        found[name] = Endpoints(listen=[], connect=[at], mode=default[name].mode, security=security_of(scenario))
    return found
