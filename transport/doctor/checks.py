"""Checks of `transport doctor`: parts of a run and the host; docs/doctor.md says why each matters."""

import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib import metadata
from typing import Literal, NamedTuple

import joblib
import threadpoolctl

from transport.agent.node import AgentNode
from transport.flight.harness import HarnessError, reserved_ports
from transport.model import compiler, native
from transport.protocol.network.endpoints import Endpoints, default_mesh, process_names
from transport.protocol.network.session import fetch_answer, open_session
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.keys import WATCHER, Keys
from transport.protocol.wire.names import RECORDER

_LATE_MS, _NAPS = 2.0, 40
# Longest round trip of an undisturbed loopback interface, number of them, time for all of them.
_LONGEST_MS, _ROUND_TRIPS, _NETWORK_S = 20.0, 20, 10.0
_STEPS = 10  # and two that warm up


class Finding(NamedTuple):
    """Result of a check: its status, the measured state, and advice if there is any."""

    status: Literal[
        "ok", "warn", "fail"
    ]  # warn: a run works, with restrictions; fail: a run does not work
    found: str
    advice: str = ""


def judged(found: str, is_bad: bool, advice: str) -> Finding:
    """Return a finding with a warning and advice if the state is bad."""
    return Finding("warn", found, advice) if is_bad else Finding("ok", found)


def checks(setup: Setup) -> Iterator[tuple[str, Finding]]:
    """Yield every check with its name as soon as it is done; all together take some seconds."""
    for name, check in CHECKS.items():
        try:
            finding = check(setup)
        except Exception as error:  # noqa: BLE001  # named in the finding
            found = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
            finding = Finding(
                "fail",
                found,
                "pip check; install the package in the message again, or report the error",
            )
        yield name, finding


def ports(setup: Setup) -> Finding:
    """Check that the ports of processes started by hand, or of the scenario's base port, are free."""
    scenario, host = setup.scenario, setup.scenario.network.host
    if scenario.network.router is not None:
        return Finding("ok", f"none needed: all processes are clients of {scenario.network.router}")
    listened = [int(place.listen[0].rsplit(":", 1)[1]) for place in default_mesh(scenario).values()]
    try:
        with reserved_ports(host, [0, *listened]):
            pass
    except HarnessError as error:
        advice = "an address of this machine as network.host; end the process that uses the port, or network.base_port"
        is_needed = scenario.network.base_port is not None or "network.host" in str(error)
        return Finding("fail" if is_needed else "warn", str(error), advice)
    return Finding("ok", f"{listened[0]} to {listened[-1]} on {host} are free")


def network(setup: Setup) -> Finding:
    """Check that two Zenoh sessions on the network's host find each other, and measure the round trip."""
    host, keys, times_ms = setup.scenario.network.host, Keys("doctor"), list[float]()
    key, deadline = keys.request(RECORDER, "ping"), time.monotonic() + _NETWORK_S
    with reserved_ports(host, [0]) as (port,):
        here = Endpoints(listen=[f"tcp/{host}:{port}"], connect=[])
        there = Endpoints(listen=[], connect=here.listen)
        with (
            closing(open_session(here, 1.0, RECORDER, keys, _NETWORK_S)) as answering,
            closing(open_session(there, 1.0, WATCHER, keys, _NETWORK_S)) as asking,
        ):
            answering.declare_queryable(key, lambda query: query.reply(key, "{}"))
            while len(times_ms) < _ROUND_TRIPS and time.monotonic() < deadline:
                asked = time.perf_counter()
                if fetch_answer(asking, key, {}, timeout_s=0.5) is not None:
                    times_ms.append(1e3 * (time.perf_counter() - asked))
    if len(times_ms) < _ROUND_TRIPS:
        advice = f"check for a firewall or a network namespace without loopback (ping {host}; ip addr show lo)"
        return Finding("fail", f"Zenoh sessions on {host} do not reach each other", advice)
    median = statistics.median(times_ms)
    found = f"Zenoh {metadata.version('eclipse-zenoh')}: a round trip takes {median:.2f} ms"
    return judged(found, median > _LONGEST_MS, "the host is busy: see cores below")


def step(setup: Setup) -> Finding:
    """Measure the step of the first agent against the sampling period."""
    times_ms = []
    with threadpoolctl.threadpool_limits(1):
        node = AgentNode(setup, 1)
        for _ in range(2 + _STEPS):
            begun = time.perf_counter()
            node.warm_up()
            times_ms.append(1e3 * (time.perf_counter() - begun))
    median, period_ms = statistics.median(times_ms[2:]), 1e3 * setup.settings.sampling_period_s
    found = f"a step of agent1 takes {median:.1f} ms, a sampling period is {period_ms:g} ms"
    advice = "in real time plans will miss deadlines: a longer period, a shorter horizon, fewer UAVs per agent"
    return judged(found, median > period_ms / 2.0, advice)


def kernels(_: Setup) -> Finding:
    """Check that the kernels of a step are compiled: otherwise a step takes several times as long."""
    found, folder = compiler.find_compiler(), compiler.cache_folder()
    if native.AVAILABLE:
        return Finding("ok", f"compiled for this processor, in {folder}")
    reason = f"{found} fails, or {folder} cannot be written" if found else "no C compiler"
    advice = "install gcc or clang, or set $CC or $PAYLOAD_TRANSPORT_CACHE"
    if not compiler.enabled():
        reason, advice = "switched off", "unset PAYLOAD_TRANSPORT_NATIVE"
    return Finding("warn", f"{reason}: a step takes several times as long", advice)


def wake_up(_: Setup) -> Finding:
    """Measure how late this process wakes up, as it does at every deadline."""
    late_ms = list[float]()
    while len(late_ms) < _NAPS:
        begun = time.monotonic()
        time.sleep(1e-3)
        late_ms.append(1e3 * (time.monotonic() - begun) - 1.0)
    found = f"after 1 ms of sleep late by {statistics.median(late_ms):.2f} ms, at most {max(late_ms):.2f} ms"
    advice = "the host is busy or saves power; for real time: priority, cores, governor (docs/realtime.md)"
    return judged(found, max(late_ms) > _LATE_MS, advice)


def cores(setup: Setup) -> Finding:
    """Compare the cores this process may use, also by its quota, with the processes of a run and its recorder."""
    usable, wanted = joblib.cpu_count(), len(process_names(setup.scenario)) + 1
    found = f"{usable} for {wanted} processes ({setup.scenario.name}), of {os.cpu_count()} in this machine"
    advice = "lockstep works, but slower; real time needs a core for each process: more cores, or fewer agents"
    return judged(found, usable < wanted, advice)


CHECKS: dict[str, Callable[[Setup], Finding]] = {
    "ports": ports,
    "network": network,
    "step": step,
    "kernels": kernels,
    "wake-up": wake_up,
    "cores": cores,
}
