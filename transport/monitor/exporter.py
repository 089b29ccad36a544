"""The command `transport metrics`: how the processes of a run are, for Prometheus to read."""

import threading
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from transport.cli.answers import fail

if TYPE_CHECKING:
    from protocol.network.session import Endpoints

EXIT_USAGE, EXIT_SCENARIO = 2, 3

# How long a process may take to answer before it counts as not there.
_PATIENCE_S = 1.0

# What is told of each process: key of its health, name of the metric, what it is.
GAUGES = (
    ("tick", "tick", "Newest tick the process knows of"),
    ("memory_bytes", "memory_bytes", "Resident memory"),
    ("threads", "threads", "Threads"),
    ("open_files", "open_files", "Open files"),
    ("clock_offset_s", "clock_offset_seconds", "By how much the coordinator's wall clock is ahead"),
    ("clock_uncertainty_s", "clock_uncertainty_seconds", "At most so much is wrong with the offset"),
    ("incarnation", "incarnation", "Which start of the process"),
)
COUNTERS = (
    ("cpu_s", "cpu_seconds", "Processor time"),
    ("refused", "refused_messages", "Messages refused"),
)


class Exporter:
    """Asks every process of a run when it is read itself.

    Args:
        run: Name of the run.
        places: Where the processes are, by name.
    """

    def __init__(self, run: str, places: "dict[str, Endpoints]") -> None:
        self._run, self._places = run, places

    def health(self, name: str) -> dict[str, Any] | None:
        """How a process is, or None if it does not say so in time."""
        from protocol.network.session import BusError, ask

        place = self._places[name]
        try:
            return dict(ask(self._run, place.connect, name, "health", {}, _PATIENCE_S, place.security))
        except BusError:
            return None

    def collect(self) -> "Iterator[Any]":
        """Metrics as `prometheus_client` wants them from a collector."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        answers = {name: self.health(name) for name in self._places}
        up = GaugeMetricFamily("transport_up", "Whether the process answers", labels=["run", "process"])
        for name, answer in answers.items():
            up.add_metric([self._run, name], float(answer is not None))
        yield up
        for family, table in ((GaugeMetricFamily, GAUGES), (CounterMetricFamily, COUNTERS)):
            for key, metric, text in table:
                found = family(f"transport_{metric}", text, labels=["run", "process"])
                for name, answer in answers.items():
                    if answer is not None and answer.get(key) is not None:
                        found.add_metric([self._run, name], float(answer[key]))
                yield found


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
    except ModuleNotFoundError as error:
        fail(f"expected the package {error.name}, got none: pip install 'payload-transport[metrics]'", EXIT_USAGE)
    from protocol.network.security import SecurityError
    from protocol.scenario.file import ScenarioError, find_scenario, read_scenario

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


def asked_places(scenario: Any, connect: Sequence[str] | None = None) -> "dict[str, Endpoints]":
    """Where each process of a scenario is asked.

    Args:
        scenario: The one they read.
        connect: Endpoints in place of the usual ones, in the order of the mesh.
    Raises: SecurityError: keys that cannot be used.
    """
    from protocol.network.process import default_mesh, process_names, security_of
    from protocol.network.session import Endpoints

    names = process_names(scenario)
    usual = default_mesh(scenario)
    if connect is not None and len(connect) != len(names):
        fail(f"--connect: expected {len(names)} endpoints, for {', '.join(names)}, got {len(connect)}", EXIT_USAGE)
    found = {}
    for i, name in enumerate(names):
        at = connect[i] if connect is not None else [*usual[name].listen, *usual[name].connect][0]
        found[name] = Endpoints(listen=[], connect=[at], mode=usual[name].mode, security=security_of(scenario))
    return found
