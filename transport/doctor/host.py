"""What a Linux host gives to a run: clock, cores, frequency, steal, limits. docs/realtime.md says why each matters."""

import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Literal

from protocol.network.endpoints import process_names
from protocol.scenario.setup import Setup

Finding = tuple[Literal["ok", "warn", "fail"], str, str]  # status, what was found, what to do

_COARSE_S = 1e-6
_LATE_MS = 2.0
_NAPS = 40
_WATCHED_S = 0.4
_STOLEN = 0.02
_PRIORITY = 10  # what docs/realtime.md proposes
_SLOW_SOURCES = ("hpet", "acpi_pm", "jiffies", "refined-jiffies")


def host_checks(setup: Setup, root: Path = Path("/")) -> Iterator[tuple[str, Finding]]:
    """Every check of the host, by name.

    Args:
        setup: The run that is to be flown.
        root: Where /proc and /sys are.
    """
    yield "clock", clock(root)
    yield "wake-up", wake_up()
    yield "time of day", time_of_day()
    yield "cores", cores(setup)
    yield "load", load(root)
    yield "steal", steal(root)
    yield "governor", governor(root)
    yield "quota", quota(root)
    yield "priority", priority(root)
    yield "memory", memory(root)


def clock(root: Path) -> Finding:
    """The steady clock that deadlines are kept by: resolution, order, source."""
    info = time.get_clock_info("monotonic")
    readings = [time.monotonic_ns() for _ in range(20_000)]
    steps = [b - a for a, b in pairwise(readings)]
    smallest_ns = min((step for step in steps if step > 0), default=0)
    source = _text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource")
    found = f"{info.implementation}, resolution {info.resolution * 1e9:g} ns, steps of {smallest_ns} ns"
    found += f", source {source}" if source else ""
    if min(steps) < 0 or not info.monotonic:
        return "fail", f"{found}; it went backwards", "a defect of the host or its hypervisor: use another one"
    if info.resolution > _COARSE_S or smallest_ns > 1e9 * _COARSE_S or source in _SLOW_SOURCES:
        return "warn", found, "real time suffers: see if the kernel offers tsc or kvm-clock as a clock source"
    return "ok", found, ""


def wake_up() -> Finding:
    """How late this process wakes up from naps: what every deadline is late by."""
    late_ms = []
    for _ in range(_NAPS):
        begun = time.monotonic()
        time.sleep(1e-3)
        late_ms.append(1e3 * (time.monotonic() - begun) - 1.0)
    late_ms.sort()
    found = f"from naps of 1 ms, late by {late_ms[_NAPS // 2]:.2f} ms (worst of {_NAPS}: {late_ms[-1]:.2f} ms)"
    if late_ms[-1] > _LATE_MS:
        return "warn", found, "the host is busy or asleep: see load, governor and priority"
    return "ok", found, ""


def time_of_day() -> Finding:
    """Whether the wall clock is set by somebody: logs of several hosts are laid side by side by it, and no more."""
    told = ""
    if shutil.which("timedatectl"):
        asked = ["timedatectl", "show", "--property=NTPSynchronized", "--value"]
        try:
            told = subprocess.run(asked, capture_output=True, text=True, timeout=3.0, check=False).stdout.strip()
        except (OSError, subprocess.TimeoutExpired):
            told = ""
    if told == "yes":
        return "ok", "synchronised", ""
    if told == "no":
        return "warn", "not synchronised", "only for logs of several hosts: timedatectl set-ntp true"
    return "ok", "whether it is synchronised cannot be told here; nothing in a run depends on it", ""


def cores(setup: Setup) -> Finding:
    """Processors this process may use, beside the processes of a run and its recorder."""
    mine = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = len(process_names(setup.scenario)) + 1
    found = f"{mine} for {wanted} processes ({setup.scenario.name}), of {os.cpu_count()} in this machine"
    if mine < wanted:
        advice = "lockstep flies all the same, slower; for real time give each process one: more cores, or fewer agents"
        return "warn", found, advice
    return "ok", found, ""


def load(root: Path) -> Finding:
    """What else the machine is doing."""
    words = _text(root / "proc/loadavg").split()
    if not words:
        return "ok", "cannot be told here", ""
    busy, all_cores = float(words[0]), os.cpu_count() or 1
    found = f"{busy:.2f} in the last minute, on {all_cores} cores"
    if busy > all_cores:
        return "warn", found, "end what else is running (top), or give the run a priority: chrt -f 10 transport run"
    return "ok", found, ""


def steal(root: Path) -> Finding:
    """What share of its processors a virtual machine does not get."""
    before = _times(root)
    time.sleep(_WATCHED_S)
    after = _times(root)
    if before is None or after is None:
        return "ok", "cannot be told here", ""
    total = after[0] - before[0]
    now = (after[1] - before[1]) / total if total > 0 else 0.0
    ever = after[1] / after[0] if after[0] else 0.0
    found = f"{now:.1%} now, {ever:.1%} since boot"
    if max(now, ever) > _STOLEN:
        return "warn", found, "other guests of the host take it: a larger or dedicated machine, or lockstep"
    return "ok", found, ""


def governor(root: Path) -> Finding:
    """Whether processors are slowed down while there is little to do."""
    files = (root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    found = sorted({_text(file) for file in files} - {""})
    if not found:
        return "ok", "the host's to decide (a virtual machine, or no frequency scaling)", ""
    if found == ["performance"]:
        return "ok", "performance", ""
    return "warn", ", ".join(found), "for real time: sudo cpupower frequency-set -g performance"


def quota(root: Path) -> Finding:
    """Whether a container stops all of a run once it has used up its share of a period."""
    words = _text(root / "sys/fs/cgroup/cpu.max").split()
    if len(words) != 2 or words[0] == "max":
        return "ok", "no limit on processor time", ""
    share = float(words[0]) / float(words[1])
    return (
        "warn",
        f"{share:g} cores' worth of time per {float(words[1]) / 1e3:g} ms",
        ("give the container cores (cpuset-cpus) instead of a quota: it stops every process for the rest of a period"),
    )


def priority(root: Path) -> Finding:
    """Whether this user may give a run a real-time priority."""
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    except (ImportError, AttributeError):
        return "ok", "cannot be told here", ""
    may = limit >= _PRIORITY or limit == resource.RLIM_INFINITY or os.geteuid() == 0
    runtime = _text(root / "proc/sys/kernel/sched_rt_runtime_us")
    found = f"rtprio {'unlimited' if limit == resource.RLIM_INFINITY else limit}, user {os.geteuid()}"
    found += f", sched_rt_runtime_us {runtime}" if runtime else ""
    if not may:
        return (
            "warn",
            found,
            "for chrt -f 10 transport run: '@group - rtprio 20' in /etc/security/limits.conf, log in again",
        )
    if runtime == "-1":
        return "warn", found, "a loop that runs wild could not be ended: sysctl kernel.sched_rt_runtime_us=950000"
    return "ok", f"{found}: chrt -f {_PRIORITY} transport run is possible", ""


def memory(root: Path) -> Finding:
    """Whether processes can be swapped out: nothing here locks its memory."""
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
        memlock = "unlimited" if limit == resource.RLIM_INFINITY else f"{limit / 1024:g} kB"
    except (ImportError, AttributeError):
        memlock = "unknown"
    swaps = [line.split()[0] for line in _text(root / "proc/swaps").splitlines()[1:] if line.strip()]
    if swaps:
        found = f"swap on {', '.join(swaps)}; memlock {memlock}"
        return "warn", found, "for real time: swapoff -a, or MemorySwapMax=0 for the unit"
    return "ok", f"no swap; memlock {memlock} (nothing here locks memory)", ""


def _times(root: Path) -> tuple[int, int] | None:
    """Clock ticks of all processors since boot, and those stolen of them."""
    words = _text(root / "proc/stat").split("\n", 1)[0].split()
    if len(words) < 9 or words[0] != "cpu":
        return None
    ticks = [int(word) for word in words[1:9]]
    return sum(ticks), ticks[7]


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
