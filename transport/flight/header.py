"""Metadata at the beginning of a run's log: the run, what computed it and where."""

import os
import platform
import time
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

from model import native
from protocol.scenario.setup import Setup


def run_header(
    setup: Setup, run: str, processes: int, scenario_toml: str, classes: Mapping[str, str]
) -> Mapping[str, str]:
    """Return the metadata of a run's log; `classes` are engine and controller with their versions, as far as known."""
    return {
        "run_id": run,
        "scenario": scenario_toml,
        "seed": str(setup.scenario.seed),
        "processes": str(processes),
        "versions": versions(),
        **classes,
        "machine": machine(),
        "command_started_ns": str(_command_started_ns()),
    }


def versions() -> str:
    """Return the versions of Python, packages and kernels that results depend on, in one line."""
    packages = ("payload-transport", "numpy", "casadi", "daqp", "clarabel", "eclipse-zenoh")
    found = [f"python {platform.python_version()}", *(f"{package} {version(package)}" for package in packages)]
    return ", ".join([*found, f"kernels {'compiled' if native.AVAILABLE else 'plain'}"])


def machine() -> str:
    """Return the machine in one line: processor, cores this process may use, system."""
    processor = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        processor = names[0] if names else processor
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{processor}, {cores} cores, {platform.system()} {platform.release()}"


def _command_started_ns() -> int:
    """Return the wall-clock time at which this process was started, ns since 1970; now where /proc is missing."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
        up_s = float(Path("/proc/uptime").read_text().split()[0])
        return time.time_ns() - round((up_s - ticks / os.sysconf("SC_CLK_TCK")) * 1e9)
    except (OSError, ValueError, IndexError):
        return time.time_ns()
