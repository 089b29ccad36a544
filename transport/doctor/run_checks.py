"""Checks with parts of a run: its ports, Zenoh sessions, and the step of an agent."""

import statistics
import threading
import time
from contextlib import closing
from importlib import metadata

import threadpoolctl

from agent.node import AgentNode
from protocol.admission.gate import Gate
from protocol.network.bus import Bus
from protocol.network.endpoints import Endpoints, default_mesh
from protocol.scenario.setup import Setup
from protocol.wire.keys import WATCHER, Keys
from protocol.wire.messages import Request
from protocol.wire.names import RECORDER
from transport.doctor.checks import Finding, judged
from transport.flight.harness import HarnessError, check_ports, free_ports

_ROUND_TRIPS = 20
# Longest round trip of an undisturbed loopback interface.
_LONGEST_MS = 20.0
_NETWORK_S = 10.0


def ports(setup: Setup) -> Finding:
    """Check that the ports of processes started by hand, or of the scenario's base port, are free."""
    scenario, host = setup.scenario, setup.scenario.network.host
    if scenario.network.router is not None:
        return Finding("ok", f"none needed: all processes are clients of {scenario.network.router}")
    listened = [int(place.listen[0].rsplit(":", 1)[1]) for place in default_mesh(scenario).values()]
    span = f"{listened[0]} to {listened[-1]} on {host}"
    try:
        with free_ports(host, 1):
            pass
    except HarnessError as error:
        return Finding("fail", str(error), "set network.host to an address of this machine")
    try:
        check_ports(host, listened)
    except HarnessError as error:
        found = f"{span}: {str(error).partition('got ')[2]}"
        if scenario.network.base_port is not None:
            return Finding("fail", found, "end the process that uses it (ss -ltnp), or set another network.base_port")
        advice = (
            "transport run takes any free ports; for processes started by hand set network.base_port, or end the "
            "process that uses it (ss -ltnp)"
        )
        return Finding("warn", found, advice)
    return Finding("ok", f"{span} are free")


def network(setup: Setup) -> Finding:
    """Check that two Zenoh sessions on the network's host find each other, and measure the round trip."""
    host = setup.scenario.network.host
    unreachable = Finding(
        "fail",
        f"Zenoh sessions on {host} do not reach each other",
        f"check for a firewall or a network namespace without loopback (ping {host}; ip addr show lo)",
    )
    with free_ports(host, 1) as (port,):
        endpoint = f"tcp/{host}:{port}"
        begun = time.monotonic()
        # Named as recorder and observer, so that Zenoh does not write to standard output.
        with (
            closing(_bus(setup, RECORDER, Endpoints(listen=[endpoint], connect=[]), serves=True)) as answering,
            closing(_bus(setup, WATCHER, Endpoints(listen=[], connect=[endpoint]), serves=False)) as asking,
        ):
            opened_s = time.monotonic() - begun
            stop = threading.Event()

            def answer() -> None:
                while not stop.is_set():
                    event = answering.next(0.05)
                    if isinstance(event, Request):
                        event.reply({})

            thread = threading.Thread(target=answer, name="doctor", daemon=True)
            thread.start()
            try:
                deadline = time.monotonic() + _NETWORK_S
                while asking.ask(RECORDER, "ping", timeout_s=0.5) is None:
                    if time.monotonic() > deadline:
                        return unreachable
                    time.sleep(0.05)
                met_s = time.monotonic() - begun
                times_ms = []
                for _ in range(_ROUND_TRIPS):
                    asked = time.perf_counter()
                    if asking.ask(RECORDER, "ping", timeout_s=2.0) is None:
                        return unreachable
                    times_ms.append(1e3 * (time.perf_counter() - asked))
            finally:
                stop.set()
                thread.join()
    median = statistics.median(times_ms)
    found = (
        f"Zenoh {metadata.version('eclipse-zenoh')}: sessions open in {opened_s:.2f} s, meet after {met_s:.2f} s; "
        f"a round trip takes {median:.2f} ms (longest of {_ROUND_TRIPS}: {max(times_ms):.1f} ms)"
    )
    return judged(found, median > _LONGEST_MS, "the host is busy: see load and cores below")


def _bus(setup: Setup, name: str, endpoints: Endpoints, *, serves: bool) -> Bus:
    return Bus(
        name=name,
        incarnation=0,
        run="doctor",
        digest="doctor",
        endpoints=endpoints,
        gate=Gate(name, Keys("doctor"), setup.shape),
        serves=serves,
    )


def step(setup: Setup) -> Finding:
    """Measure the step of the first agent against the sampling period."""
    with threadpoolctl.threadpool_limits(1):
        node = AgentNode(setup, 1)
        times_ms = []
        for _ in range(12):
            begun = time.perf_counter()
            node.warm_up()
            times_ms.append(1e3 * (time.perf_counter() - begun))
    median, period_ms = statistics.median(times_ms[2:]), 1e3 * setup.settings.sampling_period_s
    found = f"a step of agent1 takes {median:.1f} ms, a sampling period is {period_ms:g} ms"
    advice = "in real time plans will miss deadlines: a longer period, a shorter horizon, fewer UAVs per agent"
    return judged(found, median > period_ms / 2.0, advice)
