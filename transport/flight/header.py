"""Metadata at the beginning of a run's log: the run, what computed it and where."""

import os
import platform
from collections.abc import Collection, Mapping
from importlib.metadata import version
from pathlib import Path

import psutil

from agent.own import checked_controller
from model import native
from plant.engines import checked_engine
from protocol.scenario.setup import Setup
from protocol.wire.names import PLANT, agent_name


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
        "command_started_ns": str(round(psutil.Process().create_time() * 1e9)),
    }


def checked(setup: Setup, external: Collection[str] = ()) -> dict[str, str]:
    """Return names and versions of engine and controller of a run after making each once, as its processes will.

    Those of a role of which all processes are `external` are unknown.

    Raises: ScenarioError: one of them cannot be used.
    """
    agents_are_external = all(agent_name(agent) in external for agent in setup.agents)
    return {
        "engine": "external" if PLANT in external else checked_engine(setup),
        "controller": "external" if agents_are_external else checked_controller(setup),
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
