"""Runs in memory, and the times of steps, programs and messages taken from them."""

import time
from copy import deepcopy
from functools import lru_cache
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.timing import WARM_UP, quiet
from model.arrays import Array
from model.compiled import compile_functions
from mpc.controller import Controller
from mpc.qp import QP
from protocol.scenario.file import find_scenario, read_scenario
from protocol.scenario.setup import Setup
from protocol.scenario.team import resized
from protocol.wire.messages import Message, StepReport
from transport.flight import memory

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
        scenario = resized(scenario, uavs, group=1, name=None, source=path.name)
    run = Setup.of(scenario, path.name)
    compile_functions(run.system.N)  # as at the start of a run
    return run


def messages(run: Setup) -> list[Message]:
    """Return all messages of a run in the order sent; times in step reports are processor time.

    Raises: BenchmarkError: the run is not completed.
    """
    sent: list[Message] = []
    with quiet():
        control = memory.simulate(run, sent.append, time.thread_time_ns)
    if control.outcome != "completed":
        raise BenchmarkError(f"run of {run.scenario.name}: expected to be completed, got {control.reason}")
    return sent


def step_times(run: Setup) -> Array:
    """Return the processor time of the stages of all steps of a run but the first few, ms, (steps, stages)."""
    return np.array([m.times_ms for m in messages(run) if isinstance(m, StepReport) and m.tick >= WARM_UP])


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
