"""Flights in memory, and what can be had from them: times of steps, situations, programs, messages."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

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
    """The arguments of `Controller.step` at one instant of a flight without a shared law."""

    controller: Controller
    x0: Array
    u0: Array
    U: Array
    y_ref: Array


@lru_cache
def setup(name: str, *settings: str, uavs: int | None = None) -> Setup:
    """A ready scenario with some settings, or a team of another size made of it with one UAV per agent."""
    path = find_scenario(name)
    scenario = read_scenario(path, settings)
    if uavs is not None:
        scenario = resized(scenario, path.parent, uavs, group=1, name=None, source=path.name)
    run = Setup.of(scenario, path.name)
    compile_functions(run.system.N)  # as whoever starts a run does
    return run


def messages(run: Setup) -> list[Message]:
    """All messages of a flight, in the order sent; the times in step reports are processor time.

    Raises: BenchmarkError: the flight does not come to its end.
    """
    sent: list[Message] = []
    with quiet():
        control = memory.simulate(run, sent.append, time.thread_time_ns)
    if control.outcome != "completed":
        raise BenchmarkError(f"flight of {run.scenario.name}: expected to be completed, got {control.reason}")
    return sent


def step_times(run: Setup) -> Array:
    """Processor time of the stages of all steps of a flight but the first few, ms, (steps, stages)."""
    return np.array([m.times_ms for m in messages(run) if isinstance(m, StepReport) and m.tick >= WARM_UP])


def programs(run: Setup, most: int) -> list[QP]:
    """Programs that the agents solve on a flight, evenly spaced over it."""
    found: list[QP] = []
    with _overheard("solve", lambda _, qp: found.append(qp)):
        messages(run)
    return _spaced(found, most)


def situations(run: Setup, most: int) -> list[Situation]:
    """Situations that the agents meet on a flight, evenly spaced over it."""
    found: list[Situation] = []
    newest: dict[Controller, Array] = {}

    def linearise(controller: Controller, x0: Array, *_: Any) -> None:
        newest[controller] = x0

    def condense(controller: Controller, linear: Linear, _: Prediction, U: Array, y_ref: Array, *__: Any) -> None:
        x0 = newest[controller]
        found.append(Situation(controller=controller, x0=x0, u0=linear.u0, U=U.copy(), y_ref=y_ref))

    with _overheard("linearise", linearise), _overheard("condense", condense):
        messages(run)
    return _spaced(found, most)


def _spaced(found: list[T], most: int) -> list[T]:
    return [found[i] for i in np.unique(np.linspace(0, len(found) - 1, most).astype(int))]


@contextmanager
def _overheard(method: str, hear: Callable[..., None]) -> Iterator[None]:
    """While the context is open, a function is told the arguments of a method of every controller."""
    original = getattr(Controller, method)

    def heard(*arguments: Any) -> Any:
        hear(*arguments)
        return original(*arguments)

    setattr(Controller, method, heard)
    try:
        yield
    finally:
        setattr(Controller, method, original)
