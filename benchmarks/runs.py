"""Runs in memory, and the times of steps, situations, programs and messages taken from them."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar
from unittest.mock import patch

import numpy as np

from benchmarks.page import BenchmarkError
from benchmarks.timing import WARM_UP, quiet
from model.arrays import Array
from model.compiled import compile_functions
from mpc.controller import Controller, Linear
from mpc.prediction import Prediction
from mpc.qp import QP
from protocol.scenario.file import find_scenario, read_scenario
from protocol.scenario.setup import Setup
from protocol.scenario.team import resized
from protocol.wire.messages import Message, StepReport
from transport.flight import memory

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """Arguments of `Controller.step` at one tick of a run with open-loop prediction."""

    controller: Controller
    x0: Array
    u0: Array
    U: Array
    y_ref: Array


@lru_cache
def setup(name: str, *settings: str, uavs: int | None = None) -> Setup:
    """Return a scenario with some settings, or a team of another size made from it with one UAV per agent."""
    path = find_scenario(name)
    scenario = read_scenario(path, settings)
    if uavs is not None:
        scenario = resized(scenario, path.parent, uavs, group=1, name=None, source=path.name)
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
    with _observed("solve", lambda _, qp: found.append(deepcopy(qp))):
        messages(run)
    return _spaced(found, most)


def situations(run: Setup, most: int) -> list[Situation]:
    """Return situations of the agents in a run, evenly spaced over it."""
    found: list[Situation] = []
    newest: dict[Controller, Array] = {}

    def linearise(controller: Controller, x0: Array, *_: Any) -> None:
        newest[controller] = x0

    def condense(controller: Controller, linear: Linear, _: Prediction, U: Array, y_ref: Array, *__: Any) -> None:
        x0 = newest[controller]
        found.append(Situation(controller=controller, x0=x0, u0=linear.u0, U=U.copy(), y_ref=y_ref))

    with _observed("linearise", linearise), _observed("condense", condense):
        messages(run)
    return _spaced(found, most)


def _spaced(found: list[T], most: int) -> list[T]:
    return [found[i] for i in np.unique(np.linspace(0, len(found) - 1, most).astype(int))]


@contextmanager
def _observed(method: str, observe: Callable[..., None]) -> Iterator[None]:
    """Pass the arguments of a method of every controller to a function, too."""
    original = getattr(Controller, method)

    def wrapper(*arguments: Any) -> Any:
        observe(*arguments)
        return original(*arguments)

    with patch.object(Controller, method, wrapper):
        yield
