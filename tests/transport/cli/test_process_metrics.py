"""Metrics of the processes of a run for Prometheus, from answers that need no process."""

import threading
from collections.abc import Mapping
from typing import Any

import pytest
from prometheus_client import CollectorRegistry, generate_latest

from transport.cli.hosts import prometheus_metrics
from transport.cli.hosts.prometheus_metrics import Exporter
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.requests_and_answers import Reach
from transport.protocol.network.session import BusError

NAMES = ("coordinator", "plant", "agent1", "agent2")
HEALTH: Mapping[str, Mapping[str, Any]] = {
    "coordinator": {
        "name": "coordinator",
        "tick": 7,
        "memory_bytes": 41000000,
        "threads": 10,
        "open_files": 26,
        "incarnation": 3,
        "cpu_s": 1.5,
        "refused": 0,
    },
    "plant": {"tick": 8, "open_files": None},  # as on a system that does not count them
    "agent1": {},
}
# The families in the order in which they are exported, and samples by process.
EXPECTED = """
# HELP transport_up 1 if the process answers
# TYPE transport_up gauge
transport_up{process="coordinator",run="hover"} 1.0
transport_up{process="plant",run="hover"} 1.0
transport_up{process="agent1",run="hover"} 1.0
transport_up{process="agent2",run="hover"} 0.0
# HELP transport_tick Newest tick of the process
# TYPE transport_tick gauge
transport_tick{process="coordinator",run="hover"} 7.0
transport_tick{process="plant",run="hover"} 8.0
# HELP transport_memory_bytes Resident memory
# TYPE transport_memory_bytes gauge
transport_memory_bytes{process="coordinator",run="hover"} 4.1e+07
# HELP transport_threads Threads
# TYPE transport_threads gauge
transport_threads{process="coordinator",run="hover"} 10.0
# HELP transport_open_files Open files
# TYPE transport_open_files gauge
transport_open_files{process="coordinator",run="hover"} 26.0
# HELP transport_incarnation Number of this start of the process
# TYPE transport_incarnation gauge
transport_incarnation{process="coordinator",run="hover"} 3.0
# HELP transport_cpu_seconds_total Processor time
# TYPE transport_cpu_seconds_total counter
transport_cpu_seconds_total{process="coordinator",run="hover"} 1.5
# HELP transport_refused_messages_total Rejected messages
# TYPE transport_refused_messages_total counter
transport_refused_messages_total{process="coordinator",run="hover"} 0.0
"""
PATIENCE_S = 20.0


def exporter() -> Exporter:
    """Return the exporter of a run whose endpoints nothing listens on."""
    places = {
        name: Endpoints(listen=[], connect=[f"tcp/127.0.0.1:{port}"], mode="client")
        for port, name in enumerate(NAMES, start=1)
    }
    return Exporter("hover", places)


def test_the_numbers_of_all_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each number of an answer has its family, with its kind and text.

    A process that does not answer is down, and a number that it does not know is left out.
    """
    ports = {}

    def answer(
        run: str, reach: Reach, name: str, what: str, given: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        assert (run, what, given) == ("hover", "health", {})
        (ports[name],) = reach.connect
        if name not in HEALTH:
            raise BusError("not reachable")
        return HEALTH[name]

    monkeypatch.setattr(prometheus_metrics, "ask", answer)
    registry = CollectorRegistry()
    registry.register(exporter())
    assert generate_latest(registry).decode() == EXPECTED.lstrip()
    assert ports == {name: f"tcp/127.0.0.1:{port}" for port, name in enumerate(NAMES, start=1)}


def test_processes_are_asked_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reading takes as long as its slowest process: no answer waits for another one."""
    all_are_asked = threading.Barrier(len(NAMES), timeout=PATIENCE_S)

    def answer(*_: Any) -> Mapping[str, Any]:
        all_are_asked.wait()
        raise BusError("not reachable")

    monkeypatch.setattr(prometheus_metrics, "ask", answer)
    up, *_ = exporter().collect()
    assert [sample.value for sample in up.samples] == [0.0] * len(NAMES)
