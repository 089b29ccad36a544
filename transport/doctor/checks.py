"""What a run needs of its environment, checked one by one: Python, packages, ports, network, computing."""

import platform
import shutil
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from model.cache import cache_folder
from protocol.scenario.setup import Setup
from transport.doctor.host import host_checks

if TYPE_CHECKING:
    from packaging.requirements import Requirement

Status = Literal["ok", "warn", "fail"]

_DISTRIBUTION = "payload-transport"
_LEAST_PYTHON = (3, 11)
# A run of 25 s leaves 4 MB; an experiment some hundred of them.
_LEAST_DISK_MB = 500
_ROUND_TRIPS = 20
# How long a message over the loopback interface may take before something is in its way.
_LONGEST_MS = 20.0
_NETWORK_S = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """What was found in one respect.

    Attributes:
        name: What was checked.
        status: ok; warn: a run flies, but not as it could; fail: it does not.
        found: What there is.
        advice: What to do about it; empty when there is nothing to do.
    """

    name: str
    status: Status
    found: str
    advice: str = ""


def checks(setup: Setup) -> Iterator[Check]:
    """Every check, as soon as it is done; all together take some seconds.

    Args:
        setup: The run that is to be flown.
    """
    yield python()
    yield from packages()
    yield ports(setup)
    yield _guarded("network", lambda: network(setup))
    yield _guarded("step", lambda: step(setup))
    yield blas()
    yield kernels()
    yield disk(Path.cwd())
    for name, (status, found, advice) in host_checks(setup):
        yield Check(name=name, status=status, found=found, advice=advice)


def python() -> Check:
    """The interpreter."""
    found = f"{platform.python_implementation()} {platform.python_version()}, {sys.maxsize.bit_length() + 1} bit"
    if sys.version_info < _LEAST_PYTHON or sys.maxsize < 2**32:
        return Check(name="python", status="fail", found=found, advice="install a 64-bit Python 3.11 or newer")
    return Check(name="python", status="ok", found=found)


def packages(distribution: str = _DISTRIBUTION) -> Iterator[Check]:
    """What the distribution asks for, and what of its extras is there."""
    from packaging.requirements import Requirement
    from packaging.version import Version

    try:
        required = [Requirement(line) for line in metadata.requires(distribution) or []]
        version = metadata.version(distribution)
    except metadata.PackageNotFoundError:
        yield Check(
            name="packages",
            status="fail",
            found=f"{distribution} is not installed",
            advice="pip install . in its folder",
        )
        return
    wrong: list[str] = []
    right: list[str] = []
    lacking: dict[str, list[str]] = {}  # by extra
    for requirement in required:
        there = _version(requirement.name)
        if there is None or not requirement.specifier.contains(Version(there), prereleases=True):
            bucket, text = wrong, f"{requirement.name} {there or 'is missing'} (needs {requirement.specifier or 'any'})"
        else:
            bucket, text = right, f"{requirement.name} {there}"
        if _belongs(requirement):
            bucket.append(text)
        elif bucket is wrong and requirement.name != distribution:
            for extra in metadata.metadata(distribution).get_all("Provides-Extra") or []:
                if _belongs(requirement, extra):
                    lacking.setdefault(extra, []).append(requirement.name)
    name = f"{distribution} {version}"
    if wrong:
        advice = f"pip install --upgrade {distribution}, or make it anew: make clean run"
        yield Check(name="packages", status="fail", found=f"{name}: {', '.join(wrong)}", advice=advice)
    else:
        yield Check(name="packages", status="ok", found=f"{name} with {', '.join(right)}")
    absent = "; ".join(f"{extra} ({', '.join(names)})" for extra, names in lacking.items())
    found = f"not installed, needed only for what they are named after: {absent}" if absent else "all installed"
    yield Check(name="extras", status="ok", found=found)


def ports(setup: Setup) -> Check:
    """Whether processes started by hand would find their ports free, and a run with a base port of its own."""
    from protocol.network.endpoints import default_mesh
    from transport.flight.harness import HarnessError, check_ports, free_ports

    scenario, host = setup.scenario, setup.scenario.network.host
    if scenario.network.router is not None:
        return Check(name="ports", status="ok", found=f"none needed: all are clients of {scenario.network.router}")
    listened = [int(place.listen[0].rsplit(":", 1)[1]) for place in default_mesh(scenario).values()]
    span = f"{listened[0]} to {listened[-1]} on {host}"
    try:
        with free_ports(host, 1):
            pass
    except HarnessError as error:
        return Check(
            name="ports", status="fail", found=str(error), advice="set network.host to an address of this machine"
        )
    try:
        check_ports(host, listened)
    except HarnessError as error:
        taken = str(error).partition("got ")[2]
        if scenario.network.base_port is not None:
            advice = "end the process that has it (ss -ltnp), or set another network.base_port"
            return Check(name="ports", status="fail", found=f"{span}: {taken}", advice=advice)
        advice = (
            "transport run takes any free ports; for processes started by hand set network.base_port, or end the "
            "process that has it (ss -ltnp)"
        )
        return Check(name="ports", status="warn", found=f"{span}: {taken}", advice=advice)
    return Check(name="ports", status="ok", found=f"{span} are free")


def network(setup: Setup) -> Check:
    """Two Zenoh sessions on the loopback interface: whether one finds the other, and how long a question takes."""
    from protocol.admission.admission import Admission
    from protocol.network.bus import Bus
    from protocol.network.endpoints import Endpoints
    from protocol.wire.keys import WATCHER, Keys
    from protocol.wire.messages import Request
    from protocol.wire.rejections import Rejections
    from transport.flight.harness import free_ports

    run, host = "doctor", setup.scenario.network.host
    with free_ports(host, 1) as (port,):
        here = Endpoints(listen=[f"tcp/{host}:{port}"], connect=[])
        there = Endpoints(listen=[], connect=list(here.listen))

        def bus(name: str, endpoints: Endpoints, *, serves: bool) -> Bus:
            # Named as an observer, so that Zenoh leaves standard output alone.
            admission = Admission(name, Keys(run), setup, Rejections())
            return Bus(
                name=name,
                incarnation=0,
                run=run,
                digest="doctor",
                endpoints=endpoints,
                admission=admission,
                serves=serves,
            )

        begun = time.monotonic()
        with (
            closing(bus("recorder", here, serves=True)) as answering,
            closing(bus(WATCHER, there, serves=False)) as asking,
        ):
            opened_s = time.monotonic() - begun
            stop = threading.Event()

            def answer() -> None:
                while not stop.is_set():
                    event = answering.next(0.05)
                    if isinstance(event, Request):
                        event.reply({"there": True})

            thread = threading.Thread(target=answer, name="doctor", daemon=True)
            thread.start()
            try:
                deadline = time.monotonic() + _NETWORK_S
                while asking.ask("recorder", "ping", timeout_s=0.5) is None:
                    if time.monotonic() > deadline:
                        return _unreachable(host)
                    time.sleep(0.05)
                met_s = time.monotonic() - begun
                times_ms = []
                for _ in range(_ROUND_TRIPS):
                    asked = time.perf_counter()
                    if asking.ask("recorder", "ping", timeout_s=2.0) is None:
                        return _unreachable(host)
                    times_ms.append(1e3 * (time.perf_counter() - asked))
            finally:
                stop.set()
                thread.join()
    median = statistics.median(times_ms)
    found = (
        f"Zenoh {metadata.version('eclipse-zenoh')}: sessions open in {opened_s:.2f} s, meet after {met_s:.2f} s; "
        f"a round trip takes {median:.2f} ms (worst of {_ROUND_TRIPS}: {max(times_ms):.1f} ms)"
    )
    if median > _LONGEST_MS:
        return Check(name="network", status="warn", found=found, advice="the host is busy: see load and cores below")
    return Check(name="network", status="ok", found=found)


def step(setup: Setup) -> Check:
    """What a step of the first agent takes, of a sampling period."""
    import threadpoolctl

    from agent.node import AgentNode

    with threadpoolctl.threadpool_limits(1):
        node = AgentNode(setup, 1)
        times_ms = []
        for _ in range(12):
            begun = time.perf_counter()
            node.warm_up()
            times_ms.append(1e3 * (time.perf_counter() - begun))
    median, period_ms = statistics.median(times_ms[2:]), 1e3 * setup.settings.sampling_period_s
    found = f"a step of agent1 takes {median:.1f} ms, a sampling period is {period_ms:g} ms"
    if median > period_ms / 2.0:
        advice = "in real time plans will miss deadlines: a longer period, a shorter horizon, fewer UAVs per agent"
        return Check(name="step", status="warn", found=found, advice=advice)
    return Check(name="step", status="ok", found=found)


def blas() -> Check:
    """Whether linear algebra can be held to one thread: several would change bits, and fight for cores."""
    import numpy  # noqa: F401 - loads its library
    import threadpoolctl

    with threadpoolctl.threadpool_limits(1):
        limited = threadpoolctl.threadpool_info()
    free = threadpoolctl.threadpool_info()
    libraries = ", ".join(f"{pool['internal_api']} {pool['version'] or ''}".strip() for pool in free) or "none found"
    loose = [pool["internal_api"] for pool in limited if pool["num_threads"] != 1]
    if loose:
        advice = "export OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 MKL_NUM_THREADS=1"
        found = f"{', '.join(loose)} cannot be held to one thread"
        return Check(name="blas threads", status="warn", found=found, advice=advice)
    return Check(name="blas threads", status="ok", found=f"{libraries}: one thread in every process of a run")


def kernels() -> Check:
    """Whether the loops of a step are compiled: without, it takes half as long again."""
    from model import compiler, native

    found = compiler.find_compiler()
    if native.AVAILABLE:
        return Check(name="kernels", status="ok", found=f"compiled for this processor, in {cache_folder()}")
    if not compiler.enabled():
        why, advice = "switched off", "unset PAYLOAD_TRANSPORT_NATIVE"
    elif found is None:
        why, advice = "no C compiler", "install one, gcc or clang"
    else:
        why = f"{found} fails, or {cache_folder()} cannot be written"
        advice = (
            f"{found} has to compile C for a shared library; $CC names another, $PAYLOAD_TRANSPORT_CACHE another folder"
        )
    return Check(name="kernels", status="warn", found=f"{why}: steps take half as long again", advice=advice)


def disk(folder: Path) -> Check:
    """Room for run folders."""
    free_mb = shutil.disk_usage(folder).free / 1e6
    found = f"{free_mb / 1e3:.1f} GB free at {folder}"
    if free_mb < _LEAST_DISK_MB:
        return Check(name="disk", status="warn", found=found, advice="make room, or fly elsewhere: --out")
    return Check(name="disk", status="ok", found=found)


def _unreachable(host: str) -> Check:
    advice = f"look for a firewall or a network namespace without loopback (ping {host}; ip addr show lo)"
    return Check(
        name="network", status="fail", found=f"Zenoh sessions on {host} do not reach each other", advice=advice
    )


def _guarded(name: str, check: Callable[[], Check]) -> Check:
    """A check that may meet whatever an environment can do wrong: that is a finding, not the end of the others."""
    try:
        return check()
    except Exception as error:  # noqa: BLE001 - named in the finding
        return Check(
            name=name,
            status="fail",
            found=f"{type(error).__name__}: {' '.join(str(error).split())[:200]}",
            advice="pip install --force-reinstall the package it names; if that is none, report it",
        )


def _belongs(requirement: "Requirement", extra: str = "") -> bool:
    """Whether a requirement counts here, for those who ask for an extra or for everybody."""
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
