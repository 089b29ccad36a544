"""Checks of `transport doctor`: installation and host; docs/doctor.md and docs/realtime.md say why each matters."""

import os
import platform
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module, metadata
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import threadpoolctl
from packaging.requirements import Requirement
from packaging.version import Version

from model import compiler, native
from model.compiler import cache_folder
from protocol.network.endpoints import process_names
from protocol.scenario.setup import Setup

_DISTRIBUTION = "payload-transport"
_LEAST_PYTHON = (3, 11)
# A run of 25 s writes 4 MB; an experiment has some hundred runs.
_LEAST_DISK_MB = 500
_COARSE_S = 1e-6
_LATE_MS = 2.0
_NAPS = 40
_STEAL_S = 0.4  # duration of the measurement
_STOLEN = 0.02
_PRIORITY = 10  # as in docs/realtime.md
_SLOW_SOURCES = ("hpet", "acpi_pm", "jiffies", "refined-jiffies")


class Finding(NamedTuple):
    """Result of a check: its status, the measured state, and advice if there is any."""

    status: Literal["ok", "warn", "fail"]  # warn: a run works, with restrictions; fail: a run does not work
    found: str
    advice: str = ""


def judged(found: str, is_bad: bool, advice: str) -> Finding:
    """Return a finding with a warning and advice if the state is bad."""
    return Finding("warn", found, advice) if is_bad else Finding("ok", found)


_UNKNOWN = Finding("ok", "unknown")


def checks(setup: Setup) -> Iterator[tuple[str, Finding]]:
    """Yield every check with its name as soon as it is done; all together take some seconds."""
    yield "python", python()
    yield from zip(("packages", "extras"), packages(), strict=False)
    for name in ("ports", "network", "step"):
        yield name, _guarded(name, setup)
    yield "blas threads", blas()
    yield "kernels", kernels()
    yield "disk", disk(Path.cwd())
    yield from host_checks(setup)


def _guarded(name: str, setup: Setup) -> Finding:
    """Return the finding of a check of `run_checks`; any error, also of its imports, is a failed check."""
    try:
        check: Callable[[Setup], Finding] = getattr(import_module("transport.doctor.run_checks"), name)
        return check(setup)
    except Exception as error:  # noqa: BLE001 - named in the finding
        found = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        advice = "pip install --force-reinstall the package in the message; if there is none, report the error"
        return Finding("fail", found, advice)


def python() -> Finding:
    """Check the interpreter."""
    found = f"{platform.python_implementation()} {platform.python_version()}, {sys.maxsize.bit_length() + 1} bit"
    if sys.version_info < _LEAST_PYTHON or sys.maxsize < 2**32:
        return Finding("fail", found, "install a 64-bit Python 3.11 or newer")
    return Finding("ok", found)


def packages(distribution: str = _DISTRIBUTION) -> Iterator[Finding]:
    """Check the required packages, then those of the extras."""
    try:
        required = [Requirement(line) for line in metadata.requires(distribution) or []]
        name = f"{distribution} {metadata.version(distribution)}"
    except metadata.PackageNotFoundError:
        yield Finding("fail", f"{distribution} is not installed", "pip install . in its folder")
        return
    wrong: list[str] = []
    right: list[str] = []
    missing: dict[str, list[str]] = {}  # by extra
    for requirement in required:
        installed = _version(requirement.name)
        fits = installed is not None and requirement.specifier.contains(Version(installed), prereleases=True)
        if _belongs(requirement):
            needed = f"{requirement.name} {installed or 'is missing'} (needs {requirement.specifier or 'any'})"
            (right if fits else wrong).append(f"{requirement.name} {installed}" if fits else needed)
        elif not fits and requirement.name != distribution:
            for extra in metadata.metadata(distribution).get_all("Provides-Extra") or []:
                if _belongs(requirement, extra):
                    missing.setdefault(extra, []).append(requirement.name)
    if wrong:
        advice = f"pip install --upgrade {distribution}, or build it again: make clean run"
        yield Finding("fail", f"{name}: {', '.join(wrong)}", advice)
    else:
        yield Finding("ok", f"{name} with {', '.join(right)}")
    absent = "; ".join(f"{extra} ({', '.join(names)})" for extra, names in missing.items())
    yield Finding("ok", f"not installed, optional: {absent}" if absent else "all installed")


def blas() -> Finding:
    """Check that linear algebra can be limited to one thread: several would change bits and compete for cores."""
    with threadpoolctl.threadpool_limits(1):
        limited = threadpoolctl.threadpool_info()
    free = threadpoolctl.threadpool_info()
    libraries = ", ".join(f"{pool['internal_api']} {pool['version'] or ''}".strip() for pool in free) or "none found"
    unlimited = [pool["internal_api"] for pool in limited if pool["num_threads"] != 1]
    found = f"{', '.join(unlimited)} cannot be limited to" if unlimited else f"{libraries}:"
    advice = "export OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 MKL_NUM_THREADS=1"
    return judged(f"{found} one thread in every process of a run", bool(unlimited), advice)


def kernels() -> Finding:
    """Check that the kernels of a step are compiled: otherwise a step takes nearly twice as long."""
    found = compiler.find_compiler()
    if native.AVAILABLE:
        return Finding("ok", f"compiled for this processor, in {cache_folder()}")
    if not compiler.enabled():
        reason, advice = "switched off", "unset PAYLOAD_TRANSPORT_NATIVE"
    elif found is None:
        reason, advice = "no C compiler", "install gcc or clang"
    else:
        reason = f"{found} fails, or {cache_folder()} cannot be written"
        advice = f"make {found} compile shared libraries, or set $CC or $PAYLOAD_TRANSPORT_CACHE"
    return Finding("warn", f"{reason}: a step takes nearly twice as long", advice)


def disk(folder: Path) -> Finding:
    """Check the free space for run folders."""
    free_mb = shutil.disk_usage(folder).free / 1e6
    advice = "free some space, or use another folder: --out"
    return judged(f"{free_mb / 1e3:.1f} GB free at {folder}", free_mb < _LEAST_DISK_MB, advice)


def _belongs(requirement: Requirement, extra: str = "") -> bool:
    """Return whether a requirement applies here, without or with an extra."""
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def host_checks(setup: Setup, root: Path = Path("/")) -> Iterator[tuple[str, Finding]]:
    """Yield every check of the host with its name; root is the folder of /proc and /sys."""
    yield "clock", clock(root)
    yield "wake-up", wake_up()
    yield "time of day", time_of_day()
    yield "cores", cores(setup)
    for check in (load, steal, governor, quota, priority, memory):
        yield check.__name__, check(root)


def clock(root: Path) -> Finding:
    """Check the steady clock of all deadlines: resolution, order, source."""
    info = time.get_clock_info("monotonic")
    readings = [time.monotonic_ns() for _ in range(20_000)]
    steps = [b - a for a, b in pairwise(readings)]
    smallest_ns = min((step for step in steps if step > 0), default=0)
    source = _text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource")
    found = f"{info.implementation}, resolution {info.resolution * 1e9:g} ns, steps of {smallest_ns} ns"
    found += f", source {source}" if source else ""
    if min(steps) < 0 or not info.monotonic:
        advice = "a defect of the host or its hypervisor: use another host"
        return Finding("fail", f"{found}; it went backwards", advice)
    is_coarse = info.resolution > _COARSE_S or smallest_ns > 1e9 * _COARSE_S or source in _SLOW_SOURCES
    advice = "too coarse for real time: check whether the kernel offers tsc or kvm-clock as a clock source"
    return judged(found, is_coarse, advice)


def wake_up() -> Finding:
    """Measure how late this process wakes up, as it does at every deadline."""
    late_ms = []
    for _ in range(_NAPS):
        begun = time.monotonic()
        time.sleep(1e-3)
        late_ms.append(1e3 * (time.monotonic() - begun) - 1.0)
    late_ms.sort()
    found = f"after 1 ms of sleep late by {late_ms[_NAPS // 2]:.2f} ms (longest of {_NAPS}: {late_ms[-1]:.2f} ms)"
    return judged(found, late_ms[-1] > _LATE_MS, "the host is busy or saves power: see load, governor and priority")


def time_of_day() -> Finding:
    """Check that the wall clock is synchronised; only logs of several hosts need it."""
    answer = ""
    if shutil.which("timedatectl"):
        asked = ["timedatectl", "show", "--property=NTPSynchronized", "--value"]
        with suppress(OSError, subprocess.TimeoutExpired):
            answer = subprocess.run(asked, capture_output=True, text=True, timeout=3.0, check=False).stdout.strip()
    found = {"yes": "synchronised", "no": "not synchronised"}.get(answer, "unknown; no run depends on it")
    return judged(found, answer == "no", "only for logs of several hosts: timedatectl set-ntp true")


def cores(setup: Setup) -> Finding:
    """Compare the cores this process may use with the processes of a run and its recorder."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = len(process_names(setup.scenario)) + 1
    found = f"{usable} for {wanted} processes ({setup.scenario.name}), of {os.cpu_count()} in this machine"
    advice = "lockstep works, but slower; real time needs a core for each process: more cores, or fewer agents"
    return judged(found, usable < wanted, advice)


def load(root: Path) -> Finding:
    """Check the load of the machine by other processes."""
    fields = _text(root / "proc/loadavg").split()
    if not fields:
        return _UNKNOWN
    busy, all_cores = float(fields[0]), os.cpu_count() or 1
    advice = "end other processes (top), or give the run a priority: chrt -f 10 transport run"
    return judged(f"{busy:.2f} in the last minute, on {all_cores} cores", busy > all_cores, advice)


def steal(root: Path) -> Finding:
    """Measure the share of its processors that a virtual machine does not get."""
    before = _times(root)
    time.sleep(_STEAL_S)
    after = _times(root)
    if before is None or after is None:
        return _UNKNOWN
    total = after[0] - before[0]
    now = (after[1] - before[1]) / total if total > 0 else 0.0
    ever = after[1] / after[0] if after[0] else 0.0
    advice = "used by other guests of the host: use a larger or dedicated machine or lockstep"
    return judged(f"{now:.1%} now, {ever:.1%} since boot", max(now, ever) > _STOLEN, advice)


def governor(root: Path) -> Finding:
    """Check whether the processor frequency depends on the load."""
    files = (root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    found = sorted({_text(file) for file in files} - {""})
    if not found:
        return Finding("ok", "set by the host (a virtual machine, or no frequency scaling)")
    advice = "for real time: sudo cpupower frequency-set -g performance"
    return judged(", ".join(found), found != ["performance"], advice)


def quota(root: Path) -> Finding:
    """Check whether a container limits processor time, and so stops a run for parts of a period."""
    fields = _text(root / "sys/fs/cgroup/cpu.max").split()
    if len(fields) != 2 or fields[0] == "max":
        return Finding("ok", "no limit on processor time")
    quota_us, period_us = map(float, fields)
    advice = "give the container cores (cpuset-cpus) instead: a quota stops every process for the rest of a period"
    return Finding("warn", f"{quota_us / period_us:g} cores per {period_us / 1e3:g} ms", advice)


def priority(root: Path) -> Finding:
    """Check whether this user may give a run a real-time priority."""
    if not hasattr(resource, "RLIMIT_RTPRIO"):
        return _UNKNOWN
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    may = limit >= _PRIORITY or limit == resource.RLIM_INFINITY or os.geteuid() == 0
    runtime = _text(root / "proc/sys/kernel/sched_rt_runtime_us")
    found = f"rtprio {'unlimited' if limit == resource.RLIM_INFINITY else limit}, user {os.geteuid()}"
    found += f", sched_rt_runtime_us {runtime}" if runtime else ""
    if not may:
        advice = "for chrt -f 10 transport run: '@group - rtprio 20' in /etc/security/limits.conf, log in again"
        return Finding("warn", found, advice)
    if runtime == "-1":
        return Finding("warn", found, "an endless loop could not be ended: sysctl kernel.sched_rt_runtime_us=950000")
    return Finding("ok", f"{found}: chrt -f {_PRIORITY} transport run is possible")


def memory(root: Path) -> Finding:
    """Check for swap: no process of a run locks its memory."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    memlock = "unlimited" if limit == resource.RLIM_INFINITY else f"{limit / 1024:g} kB"
    swaps = [line.split()[0] for line in _text(root / "proc/swaps").splitlines()[1:] if line.strip()]
    swap = f"swap on {', '.join(swaps)}" if swaps else "no swap"
    return judged(
        f"{swap}; memlock {memlock}", bool(swaps), "for real time: swapoff -a, or MemorySwapMax=0 for the unit"
    )


def _times(root: Path) -> tuple[int, int] | None:
    """Return the clock ticks of all processors since boot, and the stolen ones of them."""
    fields = _text(root / "proc/stat").split("\n", 1)[0].split()
    if len(fields) < 9 or fields[0] != "cpu":
        return None
    ticks = [int(field) for field in fields[1:9]]
    return sum(ticks), ticks[7]


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
