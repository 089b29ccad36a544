"""Processor time of controllers over the sampling period, and the periods at which two compute the same."""

import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import threadpoolctl

from protocol.scenario.setup import Setup
from protocol.wire.messages import Message, StepReport
from transport.flight import memory

# Computation is measured for the whole team or for one agent of it.
TEAM, AGENT = "whole team", "one agent"

# Repetitions, and ticks of each short run that do not count: caches and solvers warm up.
REPEATS, QUICK_REPEATS, WARM_UP = 5, 1, 3

# What is run for it: long enough to settle, short enough that a slow minute of the machine hits a pair alike.
MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]}]"
)
QUICK_MANEUVER = "maneuver.phase=[{name='climb',duration_s=0.4,displacement_m=[0,0,-0.2]}]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """Measured processor time of a controller at one sampling period, beside that of the reference.

    Attributes:
        controller: Name of the controller.
        period_s: Its sampling period T_s.
        horizon: Its horizon N_p, steps.
        agents: Number of agents that compute.
        reference_period_s: Sampling period of the reference, whose single agent computes for the team.
        step_ms: Processor time of an agent's step, mean of each repetition.
        reference_step_ms: The same of the reference, measured right before; as many repetitions.
    """

    controller: str
    period_s: float
    horizon: int
    agents: int
    reference_period_s: float
    step_ms: Sequence[float]
    reference_step_ms: Sequence[float]

    def seconds_per_second(self, budget: str) -> list[float]:
        """Processor time per second of flight, s/s, in each repetition."""
        return [self._computing(budget) * step_ms / 1e3 / self.period_s for step_ms in self.step_ms]

    def ratios(self, budget: str) -> list[float]:
        """Processor time per second of flight over the reference's, in each repetition."""
        rate = self._computing(budget) * self.reference_period_s / self.period_s
        return [rate * own / first for own, first in zip(self.step_ms, self.reference_step_ms, strict=True)]

    def _computing(self, budget: str) -> int:
        return self.agents if budget == TEAM else 1


@dataclass(frozen=True, slots=True)
class Span:
    """An interval of sampling periods, the smallest and largest of several repetitions.

    Attributes:
        low_s: Shortest period; 0 if a repetition computes less than the reference even at the shortest one measured.
        high_s: Longest period; infinite if a repetition computes more even at the longest one measured.
    """

    low_s: float
    high_s: float

    @property
    def is_open(self) -> bool:
        """Whether an end lies outside the periods that were measured."""
        return self.low_s == 0.0 or math.isinf(self.high_s)


def step_ms(setup: Setup) -> float:
    """Mean processor time of an agent's step in a run, ms: estimate, linearise, discretise, condense, solve.

    One thread computes, so that the clock of its processor time sees all of the work.

    Raises: ValueError: a run that ends before anything can be measured.
    """
    times_ms: list[float] = []

    def record(message: Message) -> None:
        if isinstance(message, StepReport) and message.tick >= WARM_UP:
            times_ms.append(float(message.times_ms[-1]))

    with threadpoolctl.threadpool_limits(1):
        control = memory.simulate(setup, record, time.thread_time_ns)
    if not times_ms:
        raise ValueError(f"expected a run of more than {WARM_UP} ticks, got {control.outcome}: {control.reason}")
    return statistics.fmean(times_ms)


def measure_in_turns(
    reference: Setup,
    candidates: Sequence[tuple[str, Setup]],
    repeats: int,
    notify: Callable[[int], None],
    *,
    measure: Callable[[Setup], float] = step_ms,
) -> list[Load]:
    """Measure all candidates once, then all again: a slow minute of the machine falls on all of them alike.

    The reference is measured right before each candidate, so that both of a ratio see the same machine.

    Args:
        reference: Run of the controller that is compared to.
        candidates: Name and run of each other controller at each of its periods.
        repeats: Repetitions.
        notify: Called with the number of each finished repetition, from 1.
        measure: Processor time of an agent's step, ms.
    Returns: A load for each candidate, in the same order.
    """
    pairs: list[list[tuple[float, float]]] = [[] for _ in candidates]
    for repetition in range(1, repeats + 1):
        for found, (_, candidate) in zip(pairs, candidates, strict=True):
            found.append((measure(reference), measure(candidate)))
        notify(repetition)
    return [
        Load(
            controller=controller,
            period_s=candidate.settings.sampling_period_s,
            horizon=candidate.settings.horizon,
            agents=len(candidate.agents),
            reference_period_s=reference.settings.sampling_period_s,
            step_ms=[own for _, own in found],
            reference_step_ms=[first for first, _ in found],
        )
        for found, (controller, candidate) in zip(pairs, candidates, strict=True)
    ]


def equal_periods(loads: Sequence[Load], budget: str) -> Span:
    """Sampling periods at which a controller computes as much as the reference: the range over the repetitions.

    Args:
        loads: Of one controller, from the longest period to the shortest.
        budget: `TEAM` or `AGENT`.
    """
    found = list(_crossings(loads, budget))
    return Span(min(found), max(found))


def _crossings(loads: Sequence[Load], budget: str) -> Iterator[float]:
    """The equal period of each repetition, s; infinite or 0 if it lies beyond the longest or shortest measured."""
    periods_s = [load.period_s for load in loads]
    for ratios in zip(*(load.ratios(budget) for load in loads), strict=True):
        yield crossing_s(periods_s, ratios)


def crossing_s(periods_s: Sequence[float], ratios: Sequence[float]) -> float:
    """Period at which a ratio of computation passes one, s.

    Between two periods the ratio is taken to be a power of the period: exact for a step that takes equally long
    at any period, and close for one whose horizon grows.

    Args:
        periods_s: From the longest to the shortest, (n,).
        ratios: Computation over the reference's, (n,).
    Returns: Infinite if even the longest period computes more; 0 if even the shortest computes less.
    """
    if ratios[0] > 1.0:
        return math.inf
    pairs = itertools.pairwise(zip(periods_s, ratios, strict=True))
    for (longer_s, less), (shorter_s, more) in pairs:
        if more >= 1.0:
            low, high = math.log(less), math.log(more)
            share = -low / (high - low) if high > low else 0.0
            return longer_s * math.pow(shorter_s / longer_s, share)
    return periods_s[-1] if ratios[-1] == 1.0 else 0.0
