"""Runs in memory, and processor times of steps, programs and calls."""

import gc
import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import lru_cache
from typing import Any
from unittest.mock import patch

import numpy as np
import threadpoolctl
from rich.console import Console

from transport.flight import memory
from transport.flight.progress import compile_models
from transport.flight.run_files import machine
from transport.model.arrays import Array
from transport.model.kernels import native
from transport.mpc.controller import Controller
from transport.mpc.program.quadratic_program import QP
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import Team, resized
from transport.protocol.wire.messages import Message, StepReport

# Calls that are not counted, while caches fill and modules load.
WARM_UP = 3
# A climb that begins at once, so that plans differ from hover from the first tick on.
CLIMB = "maneuver.phase=[{name='climb',duration_s=1.5,displacement_m=[0.5,0,-1.0]}]"


class BenchmarkError(RuntimeError):
    """A measurement failed; one line for the user."""


@lru_cache
def setup(name: str, *settings: str, uavs: int | None = None) -> Setup:
    """Return a scenario with some settings, or a team of another size made from it with one UAV per agent."""
    path = find_scenario(name)
    scenario = read_scenario(path, settings)
    if uavs is not None:
        scenario = resized(scenario, Team(uavs=uavs, group=1), path.name)
    compile_models([scenario], Console(stderr=True))  # as at the start of a run
    return Setup.of(scenario, path.name)


def messages(run: Setup) -> list[Message]:
    """Return all messages of a run in the order sent; times in step reports are processor time.

    Raises: BenchmarkError: the run is not completed.
    """
    sent: list[Message] = []
    with quiet():
        control = memory.simulate(run, sent.append, time.thread_time_ns)
    if control.outcome != "completed":
        raise BenchmarkError(
            f"run of {run.scenario.name}: expected to be completed, got {control.reason}"
        )
    return sent


def step_times(run: Setup) -> Array:
    """Return the processor time of the stages of all steps of a run but the first few, ms, (steps, stages)."""
    return np.array(
        [m.times_ms for m in messages(run) if isinstance(m, StepReport) and m.tick >= WARM_UP]
    )


def programs(run: Setup, most: int) -> list[QP]:
    """Return programs that the agents solve in a run, evenly spaced over it."""
    found: list[QP] = []
    solve = Controller.solve

    def observed(controller: Controller, qp: QP, *arguments: Any) -> Any:
        found.append(deepcopy(qp))
        return solve(controller, qp, *arguments)

    with patch.object(Controller, "solve", observed):
        messages(run)
    return [found[i] for i in np.unique(np.linspace(0, len(found) - 1, most).astype(int))]


@contextmanager
def kernels(width: str) -> Iterator[None]:
    """Use kernels with vectors of a width in doubles, or none for "0"."""
    with patch.dict(os.environ, {"PAYLOAD_TRANSPORT_NATIVE": width}):
        library = native.load()
    with (
        patch.object(native, "KERNELS", library),
        patch.object(native, "AVAILABLE", library is not None),
    ):
        yield


@contextmanager
def quiet() -> Iterator[None]:
    """Suspend garbage collection and use one thread for linear algebra, as the processes of a run do."""
    gc.collect()
    gc.disable()
    try:
        with threadpoolctl.threadpool_limits(1):
            yield
    finally:
        gc.enable()


def times_ms(calls: Sequence[Callable[[], object]], repetitions: int = 5) -> list[float]:
    """Return the processor times of this thread for calls, each repeated after a warm-up, ms."""
    found = []
    with quiet():
        for call in calls:
            for i in range(WARM_UP + repetitions):
                start_ns = time.thread_time_ns()
                call()
                if i >= WARM_UP:
                    found.append((time.thread_time_ns() - start_ns) / 1e6)
    return found


def digits(value: float) -> str:
    """Return a number with three significant digits, more than a machine repeats."""
    return np.format_float_positional(
        value, precision=3, fractional=False, unique=False, trim="k"
    ).rstrip(".")


def spread(ms: Sequence[float]) -> str:
    """Return median and 99th percentile."""
    return f"{digits(float(np.median(ms)))} ({digits(float(np.percentile(ms, 99)))})"


def origin() -> str:
    """Return the machine and the date."""
    return f"{machine()}, Python {platform.python_version()}; {time.strftime('%Y-%m-%d')}"
