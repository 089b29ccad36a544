"""Command `metrics`: the health of the processes of a run, served to Prometheus."""

import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import typer
from typer import Option

from transport.cli.options import FormatOption, ScenarioOption, SetOption, read_setup
from transport.cli.output import Format, fail, show
from transport.flight.signals import take_interrupt
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.mesh import default_mesh, process_names, security_of
from transport.protocol.network.requests_and_answers import Reach, ask
from transport.protocol.network.session import BusError
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.wire.key_expressions import Keys

# Numbers in the answer of a process to `health` (docs/reference/protocol.md): name in Prometheus and
# description.
METRICS = {
    "tick": ("tick", "Newest tick of the process"),
    "memory_bytes": ("memory_bytes", "Resident memory"),
    "threads": ("threads", "Threads"),
    "open_files": ("open_files", "Open files"),
    "incarnation": ("incarnation", "Number of this start of the process"),
    "cpu_s": ("cpu_seconds", "Processor time"),
    "refused": ("refused_messages", "Rejected messages"),
}
# Those that only grow while a process runs are counters, all others gauges.
_GROWING = ("cpu_s", "refused")
# Timeout after which a process counts as down.
_TIMEOUT_S = 1.0
# Processes that are asked at the same time. Prometheus waits 10 s for a reading: one after the other,
# a few unreachable processes would take longer.
_AT_ONCE = 16
_LOOKS_FOR_SIGNALS_S = 0.2


class Exporter:
    """Collector of `prometheus_client` that asks processes of a run at each reading."""

    def __init__(self, run: str, places: Mapping[str, Endpoints]) -> None:
        self._run = run
        self._places = places

    def collect(self) -> Iterator[Any]:
        """Yield the metrics, as `prometheus_client` expects of a collector."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        with ThreadPoolExecutor(_AT_ONCE) as pool:
            readings = dict(zip(self._places, pool.map(self._read, self._places), strict=True))

        for key, (metric, text) in {"up": ("up", "1 if the process answers"), **METRICS}.items():
            family = CounterMetricFamily if key in _GROWING else GaugeMetricFamily
            samples = family(f"transport_{metric}", text, labels=["run", "process"])
            for name, reading in readings.items():
                if reading.get(key) is not None:
                    samples.add_metric([self._run, name], float(reading[key]))
            yield samples

    def _read(self, name: str) -> dict[str, Any]:
        """Return the health of a process, and `up`: 1, or 0 alone if it does not answer in time."""
        place = self._places[name]
        reach = Reach(connect=place.connect, security=place.security, timeout_s=_TIMEOUT_S)
        try:
            answer = ask(self._run, reach, name, "health", {})
        except BusError:
            return {"up": 0.0}
        return {**answer, "up": 1.0}


def metrics(
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    run: str | None = Option(
        None, metavar="NAME", help="Name of the run; the scenario's by default."
    ),
    connect: list[str] | None = Option(
        None,
        metavar="ENDPOINT",
        help="Endpoints of coordinator, plant, agent 1, ... in this order.",
    ),
    port: int = Option(
        9464, metavar="PORT", min=1, max=65535, help="Port to serve on, at 127.0.0.1."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Export process metrics to Prometheus.

    Example: transport metrics --scenario resilient --port 9464
    """
    from prometheus_client import CollectorRegistry, start_http_server

    described = read_setup(scenario, settings, allow_large=True).scenario
    name = run or described.name
    if not Keys.allows(name):
        fail(f"--run: expected the name of a run, as its processes have it, got {name!r}")
    registry = CollectorRegistry()
    registry.register(Exporter(name, process_endpoints(described, connect)))
    try:
        server, thread = start_http_server(port, "127.0.0.1", registry)
    except OSError as error:
        fail(f"--port: cannot serve on {port} ({error.strerror})")
    address = f"http://127.0.0.1:{port}/metrics"
    show(output, {"address": address})
    typer.echo(address, err=True)
    try:
        # Waits for Ctrl-C, and wakes up to see it: a signal that a thread of the server takes does
        # not end the sleep of this one.
        while True:
            time.sleep(_LOOKS_FOR_SIGNALS_S)
    except KeyboardInterrupt:
        take_interrupt()
        server.shutdown()
        thread.join()


def process_endpoints(
    scenario: Scenario, connect: Sequence[str] | None = None
) -> dict[str, Endpoints]:
    """Return the endpoints at which to ask each process of a scenario but the recorder, by name.

    Given endpoints, in the order of the mesh, replace the default ones.

    Raises: SecurityError: the keys cannot be used.
    """
    default = default_mesh(scenario)
    names = process_names(scenario)
    addresses = connect or [[*default[name].listen, *default[name].connect][0] for name in names]
    if len(addresses) != len(names):
        expected = f"expected {len(names)} endpoints, for {', '.join(names)}"
        fail(f"--connect: {expected}, got {len(addresses)}")

    security = security_of(scenario)
    return {
        name: Endpoints(listen=[], connect=[address], mode=default[name].mode, security=security)
        for name, address in zip(names, addresses, strict=True)
    }
