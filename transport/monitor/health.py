"""Health of the processes of a run: one table of its facts, of which `transport status` and Prometheus are views."""

from collections.abc import Iterator
from typing import Any, NamedTuple

from protocol.network.endpoints import Endpoints
from protocol.network.session import BusError, ask

# Timeout after which a process counts as down.
_TIMEOUT_S = 1.0


class Fact(NamedTuple):
    """A number in the answer of a process to `health` (docs/protocol.md).

    Attributes:
        metric: Its name in Prometheus, without the prefix.
        text: Its description there.
        label: Its name in the table of `transport status`.
        scale: Factor for the table; None for a value as it is.
        unit: Unit behind the scaled value.
        counts: Whether it only grows.
    """

    metric: str
    text: str
    label: str
    scale: float | None = None
    unit: str = ""
    counts: bool = False


FACTS = {
    "tick": Fact("tick", "Newest tick of the process", "tick"),
    "memory_bytes": Fact("memory_bytes", "Resident memory", "memory", 1e-6, "MB"),
    "threads": Fact("threads", "Threads", "threads"),
    "open_files": Fact("open_files", "Open files", "open files"),
    "clock_offset_s": Fact(
        "clock_offset_seconds", "Lead of the coordinator's wall clock", "coordinator's clock", 1e3, "ms ahead"
    ),
    "clock_uncertainty_s": Fact("clock_uncertainty_seconds", "Largest error of the offset", "known within", 1e3, "ms"),
    "incarnation": Fact("incarnation", "Number of this start of the process", "incarnation"),
    "cpu_s": Fact("cpu_seconds", "Processor time", "processor time", 1.0, "s", counts=True),
    "refused": Fact("refused_messages", "Rejected messages", "refused messages", counts=True),
}


class Exporter:
    """Collector of `prometheus_client` that asks every process of a run, each at its endpoints, at each reading."""

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
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily  # an extra

        answers = {name: self.health(name) for name in self._places}
        up = GaugeMetricFamily("transport_up", "1 if the process answers", labels=["run", "process"])
        for name, answer in answers.items():
            up.add_metric([self._run, name], float(answer is not None))
        yield up
        for key, fact in FACTS.items():
            family = CounterMetricFamily if fact.counts else GaugeMetricFamily
            found = family(f"transport_{fact.metric}", fact.text, labels=["run", "process"])
            for name, answer in answers.items():
                if answer is not None and answer.get(key) is not None:
                    found.add_metric([self._run, name], float(answer[key]))
            yield found
