"""Export of process health as Prometheus metrics."""

from collections.abc import Iterator
from typing import Any

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

from protocol.network.endpoints import Endpoints
from protocol.network.session import BusError, ask

# Timeout after which a process counts as down.
_TIMEOUT_S = 1.0

# Metrics of each process: key of its health, name, description.
GAUGES = (
    ("tick", "tick", "Newest tick of the process"),
    ("memory_bytes", "memory_bytes", "Resident memory"),
    ("threads", "threads", "Threads"),
    ("open_files", "open_files", "Open files"),
    ("clock_offset_s", "clock_offset_seconds", "Lead of the coordinator's wall clock"),
    ("clock_uncertainty_s", "clock_uncertainty_seconds", "Largest error of the offset"),
    ("incarnation", "incarnation", "Number of this start of the process"),
)
COUNTERS = (
    ("cpu_s", "cpu_seconds", "Processor time"),
    ("refused", "refused_messages", "Rejected messages"),
)


class Exporter:
    """Collector that asks every process of a run, each at its endpoints, at each reading."""

    def __init__(self, run: str, places: dict[str, Endpoints]) -> None:
        self._run, self._places = run, places

    def health(self, name: str) -> dict[str, Any] | None:
        """Return the health of a process, or None after the timeout."""
        place = self._places[name]
        try:
            return dict(ask(self._run, place.connect, name, "health", {}, _TIMEOUT_S, place.security))
        except BusError:
            return None

    def collect(self) -> Iterator[Any]:
        """Yield the metrics, as `prometheus_client` expects of a collector."""
        answers = {name: self.health(name) for name in self._places}
        up = GaugeMetricFamily("transport_up", "1 if the process answers", labels=["run", "process"])
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
