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
from transport.flight.local_processes import HarnessError, reserved_ports
from transport.model.kernels import compiler, native
from transport.model.kernels.casadi_functions import compile_functions
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.mesh import default_mesh, process_names
from transport.protocol.network.session import fetch_answer, open_session
from transport.protocol.scenario.setup.model_objects import kinds_of
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.key_expressions import WATCHER, Keys
from transport.protocol.wire.names import RECORDER

# Wake-ups: how many are measured, and the latest that is no reason for a warning, ms.
_NAPS = 40
_NAP_S = 1e-3
_LATE_MS = 2.0
# Round trips on the loopback interface: how many, the longest of an undisturbed one in ms, and the
# time for all of them in s.
_ROUND_TRIPS = 20
_LONGEST_MS = 20.0
_NETWORK_S = 10.0
_ANSWER_S = 0.5  # for each of them
# Steps of an agent: how many are measured, after some that warm up.
_STEPS = 10
_WARM_UP = 2
_MOST_OF_PERIOD = 0.5  # share of a sampling period that a step may take without a warning


class DoctorFinding(NamedTuple):
    """Result of a check."""

    status: Literal["ok", "warn", "fail"]  # warn: a run works, with restrictions; fail: none does
    found: str  # measured state
    advice: str = ""


def judged(state: str, is_bad: bool, advice: str) -> DoctorFinding:
    """Return a finding with a warning and advice if the state is bad."""
    return DoctorFinding("warn", state, advice) if is_bad else DoctorFinding("ok", state)


def checks(setup: Setup) -> Iterator[tuple[str, DoctorFinding]]:
    """Yield every check with its name as soon as it is done; all together take some seconds."""
    for name, check in CHECKS.items():
        try:
            finding = check(setup)
        except Exception as error:  # noqa: BLE001  # named in the finding
            text = " ".join(str(error).split())[:200]
            advice = "pip check; install the package in the message again, or report the error"
            finding = DoctorFinding("fail", f"{type(error).__name__}: {text}", advice)
        yield name, finding


def ports(setup: Setup) -> DoctorFinding:
    """Check that the ports of processes started by hand, or of the scenario's base port, are free."""
    network = setup.scenario.network
    if network.router is not None:
        return DoctorFinding("ok", f"none needed: all processes are clients of {network.router}")

    places = default_mesh(setup.scenario).values()
    listened = [int(place.listen[0].rsplit(":", 1)[1]) for place in places]
    try:
        with reserved_ports(network.host, [0, *listened]):
            pass
    except HarnessError as error:
        advice = (
            "an address of this machine as network.host; end the process that uses the port, "
            "or network.base_port"
        )
        # Without a base port `transport run` takes any free ports.
        is_needed = network.base_port is not None or "network.host" in str(error)
        return DoctorFinding("fail" if is_needed else "warn", str(error), advice)
    return DoctorFinding("ok", f"{listened[0]} to {listened[-1]} on {network.host} are free")


def network(setup: Setup) -> DoctorFinding:
    """Check that two Zenoh sessions on the network's host find each other, and measure the round trip."""
    host = setup.scenario.network.host
    try:
        times_ms = _round_trips_ms(host)
    except HarnessError as error:
        return DoctorFinding("fail", str(error), "an address of this machine as network.host")
    if len(times_ms) < _ROUND_TRIPS:
        advice = (
            "check for a firewall or a network namespace without loopback "
            f"(ping {host}; ip addr show lo)"
        )
        return DoctorFinding("fail", f"Zenoh sessions on {host} do not reach each other", advice)

    median_ms = statistics.median(times_ms)
    state = f"Zenoh {metadata.version('eclipse-zenoh')}: a round trip takes {median_ms:.2f} ms"
    return judged(state, median_ms > _LONGEST_MS, "the host is busy: see cores below")


def _round_trips_ms(host: str) -> list[float]:
    """Return the times of requests between two sessions, ms; fewer if too many get no answer."""
    keys = Keys("doctor")
    key = keys.request(RECORDER, "ping")
    deadline_s = time.monotonic() + _NETWORK_S
    times_ms: list[float] = []

    with reserved_ports(host, [0]) as (port,):
        here = Endpoints(listen=[f"tcp/{host}:{port}"], connect=[])
        there = Endpoints(listen=[], connect=here.listen)
        with (
            closing(open_session(here, 1.0, RECORDER, keys, _NETWORK_S)) as answering,
            closing(open_session(there, 1.0, WATCHER, keys, _NETWORK_S)) as asking,
        ):
            answering.declare_queryable(key, lambda query: query.reply(key, "{}"))
            while len(times_ms) < _ROUND_TRIPS and time.monotonic() < deadline_s:
                asked_s = time.perf_counter()
                if fetch_answer(asking, key, {}, timeout_s=_ANSWER_S) is not None:
                    times_ms.append(1e3 * (time.perf_counter() - asked_s))
    return times_ms


def step(setup: Setup) -> DoctorFinding:
    """Measure the step of the first agent against the sampling period."""
    setup = Setup.of(setup.scenario, setup.scenario.name)  # with the model as compiled by now
    times_ms = []
    with threadpoolctl.threadpool_limits(1):
        node = AgentNode(setup.run, 1)
        for _ in range(_WARM_UP + _STEPS):
            begun_s = time.perf_counter()
            node.warm_up()
            times_ms.append(1e3 * (time.perf_counter() - begun_s))

    median_ms = statistics.median(times_ms[_WARM_UP:])
    period_ms = 1e3 * setup.settings.sampling_period_s
    state = f"a step of agent1 takes {median_ms:.1f} ms, a sampling period is {period_ms:g} ms"
    advice = (
        "in real time plans will miss deadlines: a longer period, a shorter horizon, "
        "fewer UAVs per agent"
    )
    return judged(state, median_ms > _MOST_OF_PERIOD * period_ms, advice)


def kernels(setup: Setup) -> DoctorFinding:
    """Compile the model and the kernels of a step: otherwise a step takes several times as long."""
    folder = compiler.cache_folder()
    models = [compile_functions(*kind) for kind in kinds_of(setup.scenario)]
    if native.AVAILABLE and all(models):
        width = native.KERNELS.vector_width()
        return DoctorFinding(
            "ok", f"compiled for this processor, vectors of {width} doubles, in {folder}"
        )

    if not compiler.enabled():
        reason = "switched off"
        advice = "unset PAYLOAD_TRANSPORT_NATIVE"
    else:
        c_compiler = compiler.find_compiler()
        fails = f"{c_compiler} fails, or {folder} cannot be written"
        reason = fails if c_compiler else "no C compiler"
        advice = "install gcc or clang, or set $CC or $PAYLOAD_TRANSPORT_CACHE"
    return DoctorFinding("warn", f"{reason}: a step takes several times as long", advice)


def wake_up(_: Setup) -> DoctorFinding:
    """Measure how late this process wakes up, as it does at every deadline."""
    late_ms: list[float] = []
    while len(late_ms) < _NAPS:
        begun_s = time.monotonic()
        time.sleep(_NAP_S)
        late_ms.append(1e3 * (time.monotonic() - begun_s - _NAP_S))

    median_ms = statistics.median(late_ms)
    state = f"after {1e3 * _NAP_S:g} ms of sleep late by {median_ms:.2f} ms, at most {max(late_ms):.2f} ms"
    advice = (
        "the host is busy or saves power; for real time: priority, cores, governor "
        "(docs/realtime.md)"
    )
    return judged(state, max(late_ms) > _LATE_MS, advice)


def cores(setup: Setup) -> DoctorFinding:
    """Compare the cores this process may use with the processes of a run and its recorder.

    Quotas of a container count as well.
    """
    usable = joblib.cpu_count()
    wanted = len(process_names(setup.scenario)) + 1
    state = (
        f"{usable} for {wanted} processes ({setup.scenario.name}), "
        f"of {os.cpu_count()} in this machine"
    )
    advice = (
        "runs take longer; in real time processes share cores as long as all steps fit into a "
        "period: a run's summary counts deadlines missed"
    )
    return judged(state, usable < wanted, advice)


CHECKS: dict[str, Callable[[Setup], DoctorFinding]] = {
    "ports": ports,
    "network": network,
    "kernels": kernels,
    "step": step,
    "wake-up": wake_up,
    "cores": cores,
}
