"""Health of every process of a run, as Prometheus metrics."""

from collections.abc import Iterator
from typing import Any

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

from protocol.network.endpoints import Endpoints
from protocol.network.session import BusError, ask

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

    def __init__(self, run: str, places: dict[str, Endpoints]) -> None:
        self._run, self._places = run, places

    def health(self, name: str) -> dict[str, Any] | None:
        """How a process is, or None if it does not say so in time."""
        place = self._places[name]
        try:
            return dict(ask(self._run, place.connect, name, "health", {}, _PATIENCE_S, place.security))
        except BusError:
            return None

    def collect(self) -> Iterator[Any]:
        """Metrics as `prometheus_client` wants them from a collector."""
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
