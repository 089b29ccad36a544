"""Checks of `transport doctor`: installation, parts of a run, host; docs/doctor.md says why each matters."""

import os
import platform
import resource
import shutil
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib import metadata
from pathlib import Path
from typing import Literal, NamedTuple

import psutil
import threadpoolctl
from packaging.requirements import Requirement

from agent.node import AgentNode
from model import compiler, native
from protocol.admission.gate import Gate
from protocol.network.bus import Bus
from protocol.network.endpoints import Endpoints, default_mesh, process_names
from protocol.scenario.setup import Setup
from protocol.wire.keys import WATCHER, Keys
from protocol.wire.messages import Request
from protocol.wire.names import RECORDER
from transport.flight.harness import HarnessError, check_ports, free_ports

_DISTRIBUTION = "payload-transport"
# Folder of /proc and /sys.
_ROOT = Path("/")
# A run of 25 s writes 4 MB; an experiment has some hundred runs.
_LEAST_DISK_MB = 500
_LATE_MS, _NAPS = 2.0, 40
_PRIORITY = 10  # as in docs/realtime.md
# Longest round trip of an undisturbed loopback interface, number of them, time for the first.
_LONGEST_MS, _ROUND_TRIPS, _NETWORK_S = 20.0, 20, 10.0
_STEPS = 10  # and two that warm up


class Finding(NamedTuple):
    """Result of a check: its status, the measured state, and advice if there is any."""

    status: Literal["ok", "warn", "fail"]  # warn: a run works, with restrictions; fail: a run does not work
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
            advice = "pip install --force-reinstall the package in the message; if there is none, report the error"
            finding = Finding("fail", found, advice)
        yield name, finding


def packages(_: Setup) -> Finding:
    """Check Python and the required packages."""
    found, wrong = f"{_DISTRIBUTION} {metadata.version(_DISTRIBUTION)}, python {platform.python_version()}", []
    for requirement in map(Requirement, metadata.requires(_DISTRIBUTION) or []):
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            try:
                version = metadata.version(requirement.name)
            except metadata.PackageNotFoundError:
                version = None
            if version is None or not requirement.specifier.contains(version, prereleases=True):
                wrong.append(f"{requirement.name} {version or 'is missing'} (needs {requirement.specifier or 'any'})")
    if wrong:
        advice = f"pip install --upgrade {_DISTRIBUTION}, or build it again: make clean run"
        return Finding("fail", f"{found}: {', '.join(wrong)}", advice)
    return Finding("ok", f"{found}, and all packages")


def ports(setup: Setup) -> Finding:
    """Check that the ports of processes started by hand, or of the scenario's base port, are free."""
    scenario, host = setup.scenario, setup.scenario.network.host
    if scenario.network.router is not None:
        return Finding("ok", f"none needed: all processes are clients of {scenario.network.router}")
    listened = [int(place.listen[0].rsplit(":", 1)[1]) for place in default_mesh(scenario).values()]
    span = f"{listened[0]} to {listened[-1]} on {host}"
    try:
        with free_ports(host, 1):
            check_ports(host, listened)
    except HarnessError as error:
        advice = "an address of this machine as network.host; end the process that uses the port, or network.base_port"
        is_needed = scenario.network.base_port is not None or "network.host" in str(error)
        return Finding("fail" if is_needed else "warn", str(error), advice)
    return Finding("ok", f"{span} are free")


def network(setup: Setup) -> Finding:
    """Check that two Zenoh sessions on the network's host find each other, and measure the round trip."""
    host, times_ms = setup.scenario.network.host, list[float]()
    with free_ports(host, 1) as (port,):
        endpoint, stop = f"tcp/{host}:{port}", threading.Event()
        # Named as recorder and observer, so that Zenoh does not write to standard output.
        with (
            closing(_bus(setup, RECORDER, Endpoints(listen=[endpoint], connect=[]), serves=True)) as answering,
            closing(_bus(setup, WATCHER, Endpoints(listen=[], connect=[endpoint]), serves=False)) as asking,
        ):

            def answer() -> None:
                while not stop.is_set():
                    event = answering.next(0.05)
                    if isinstance(event, Request):
                        event.reply({})

            thread = threading.Thread(target=answer, name="doctor", daemon=True)
            thread.start()
            deadline = time.monotonic() + _NETWORK_S
            while len(times_ms) < _ROUND_TRIPS and time.monotonic() < deadline:
                asked = time.perf_counter()
                if asking.ask(RECORDER, "ping", timeout_s=0.5) is not None:
                    times_ms.append(1e3 * (time.perf_counter() - asked))
            stop.set()
            thread.join()
    if len(times_ms) < _ROUND_TRIPS:
        advice = f"check for a firewall or a network namespace without loopback (ping {host}; ip addr show lo)"
        return Finding("fail", f"Zenoh sessions on {host} do not reach each other", advice)
    median = statistics.median(times_ms)
    found = f"Zenoh {metadata.version('eclipse-zenoh')}: a round trip takes {median:.2f} ms"
    found += f" (longest of {_ROUND_TRIPS}: {max(times_ms):.1f} ms)"
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
    """Check that the kernels of a step are compiled: otherwise a step takes nearly twice as long."""
    found, folder = compiler.find_compiler(), compiler.cache_folder()
    if native.AVAILABLE:
        return Finding("ok", f"compiled for this processor, in {folder}")
    if not compiler.enabled():
        reason, advice = "switched off", "unset PAYLOAD_TRANSPORT_NATIVE"
    elif found is None:
        reason, advice = "no C compiler", "install gcc or clang"
    else:
        reason = f"{found} fails, or {folder} cannot be written"
        advice = f"make {found} compile shared libraries, or set $CC or $PAYLOAD_TRANSPORT_CACHE"
    return Finding("warn", f"{reason}: a step takes nearly twice as long", advice)


def disk(_: Setup) -> Finding:
    """Check the free space for run folders."""
    free_mb = shutil.disk_usage(Path.cwd()).free / 1e6
    advice = "free some space, or use another folder: --out"
    return judged(f"{free_mb / 1e3:.1f} GB free at {Path.cwd()}", free_mb < _LEAST_DISK_MB, advice)


def wake_up(_: Setup) -> Finding:
    """Measure how late this process wakes up, as it does at every deadline."""
    late_ms = list[float]()
    while len(late_ms) < _NAPS:
        begun = time.monotonic()
        time.sleep(1e-3)
        late_ms.append(1e3 * (time.monotonic() - begun) - 1.0)
    found = f"after 1 ms of sleep late by {statistics.median(late_ms):.2f} ms"
    found += f" (longest of {_NAPS}: {max(late_ms):.2f} ms)"
    return judged(found, max(late_ms) > _LATE_MS, "the host is busy or saves power: see cores, governor and priority")


def cores(setup: Setup) -> Finding:
    """Compare the cores this process may use with the processes of a run and its recorder."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = len(process_names(setup.scenario)) + 1
    found = f"{usable} for {wanted} processes ({setup.scenario.name}), of {os.cpu_count()} in this machine"
    advice = "lockstep works, but slower; real time needs a core for each process: more cores, or fewer agents"
    return judged(found, usable < wanted, advice)


def governor(_: Setup) -> Finding:
    """Check whether the processor frequency depends on the load."""
    files = (_ROOT / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    found = sorted({file.read_text().strip() for file in files})
    if not found:
        return Finding("ok", "set by the host (a virtual machine, or no frequency scaling)")
    advice = "for real time: sudo cpupower frequency-set -g performance"
    return judged(", ".join(found), found != ["performance"], advice)


def quota(_: Setup) -> Finding:
    """Check whether a container limits processor time, and so stops a run for parts of a period."""
    fields = _text("sys/fs/cgroup/cpu.max").split()
    if len(fields) != 2 or fields[0] == "max":
        return Finding("ok", "no limit on processor time")
    quota_us, period_us = map(float, fields)
    advice = "give the container cores (cpuset-cpus) instead: a quota stops every process for the rest of a period"
    return Finding("warn", f"{quota_us / period_us:g} cores per {period_us / 1e3:g} ms", advice)


def priority(_: Setup) -> Finding:
    """Check whether this user may give a run a real-time priority."""
    if not hasattr(resource, "RLIMIT_RTPRIO"):
        return Finding("ok", "unknown")
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    may = limit >= _PRIORITY or limit == resource.RLIM_INFINITY or os.geteuid() == 0
    found = f"rtprio {'unlimited' if limit == resource.RLIM_INFINITY else limit}, user {os.geteuid()}"
    runtime = _text("proc/sys/kernel/sched_rt_runtime_us")
    if may and runtime == "-1":
        advice = "an endless loop could not be ended: sysctl kernel.sched_rt_runtime_us=950000"
        return Finding("warn", f"{found}, sched_rt_runtime_us {runtime}", advice)
    advice = "for chrt -f 10 transport run: '@group - rtprio 20' in /etc/security/limits.conf, log in again"
    return judged(found, not may, advice)


def memory(_: Setup) -> Finding:
    """Check for swap: no process of a run locks its memory."""
    swap = psutil.swap_memory().total
    advice = "for real time: swapoff -a, or MemorySwapMax=0 for the unit"
    return judged(f"{swap / 1e9:.1f} GB of swap", swap > 0, advice)


def _bus(setup: Setup, name: str, endpoints: Endpoints, *, serves: bool) -> Bus:
    gate = Gate(name, Keys("doctor"), setup.shape)
    return Bus(name=name, incarnation=0, run="doctor", digest="doctor", endpoints=endpoints, gate=gate, serves=serves)


def _text(path: str) -> str:
    try:
        return (_ROOT / path).read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


CHECKS: dict[str, Callable[[Setup], Finding]] = {
    "packages": packages,
    "ports": ports,
    "network": network,
    "step": step,
    "kernels": kernels,
    "disk": disk,
    "wake-up": wake_up,
    "cores": cores,
    "governor": governor,
    "quota": quota,
    "priority": priority,
    "memory": memory,
}
