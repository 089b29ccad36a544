"""Processor time of controllers over the sampling period, and the periods at which two compute the same."""

import itertools
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import threadpoolctl

from protocol.scenario.setup import Setup
from protocol.wire.messages import Message, StepReport
from transport.flight import memory

# Budgets of computation: the whole team or one agent.
TEAM, AGENT = "whole team", "one agent"

# Repetitions, and first ticks of each run that are not counted: caches and solvers warm up.
REPEATS, QUICK_REPEATS, WARM_UP = 5, 1, 3

# Maneuver of a measurement: long enough to settle, short enough that both runs of a pair see the same machine.
MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]}]"
)
QUICK_MANEUVER = "maneuver.phase=[{name='climb',duration_s=0.4,displacement_m=[0,0,-0.2]}]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """Measured processor time of a controller at one sampling period, beside that of the reference.

    The single agent of the reference computes for the team.
    """

    controller: str
    period_s: float  # sampling period T_s
    horizon: int  # N_p, steps
    agents: int  # number of agents
    reference_period_s: float
    step_ms: Sequence[float]  # mean processor time of an agent's step in each repetition, ms
    reference_step_ms: Sequence[float]  # the same of the reference, measured immediately before, ms

    def seconds_per_second(self, budget: str) -> list[float]:
        """Return processor time per simulated second in each repetition, s/s."""
        return [self._agents(budget) * step_ms / 1e3 / self.period_s for step_ms in self.step_ms]

    def ratios(self, budget: str) -> list[float]:
        """Return processor time per simulated second over the reference's, in each repetition."""
        rate = self._agents(budget) * self.reference_period_s / self.period_s
        return [rate * own / first for own, first in zip(self.step_ms, self.reference_step_ms, strict=True)]

    def _agents(self, budget: str) -> int:
        return self.agents if budget == TEAM else 1


@dataclass(frozen=True, slots=True)
class PeriodRange:
    """Range of sampling periods, s, over several repetitions.

    The low end is 0 if a repetition computes less than the reference even at the shortest measured period; the high end
    is infinite if one computes more even at the longest.
    """

    low_s: float
    high_s: float

    @property
    def is_open(self) -> bool:
        """Whether an end is outside the measured periods."""
        return self.low_s == 0.0 or math.isinf(self.high_s)


def step_ms(setup: Setup) -> float:
    """Return the mean processor time of an agent's step in a run, all stages of computation, ms.

    Raises: ValueError: the run ends before the first counted tick.
    """
    times_ms: list[float] = []

    def record(message: Message) -> None:
        if isinstance(message, StepReport) and message.tick >= WARM_UP:
            times_ms.append(float(message.times_ms[-1]))

    with threadpoolctl.threadpool_limits(1):  # the clock measures this thread only
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
    """Measure all candidates once, then all again, so that a slow period of the machine affects all alike.

    The reference is measured immediately before each candidate, so that both of a ratio see the same machine. A
    candidate is the name and run of a controller at one of its periods. The function notify gets the number of each
    finished repetition, from 1; measure returns the processor time of an agent's step, ms.

    Returns: The load of each candidate, in the same order.
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


def equal_periods(loads: Sequence[Load], budget: str) -> PeriodRange:
    """Return the range of sampling periods at which a controller computes as much as the reference.

    Args:
        loads: Loads of one controller, from the longest period to the shortest.
        budget: `TEAM` or `AGENT`.
    """
    periods_s = [load.period_s for load in loads]
    repetitions = zip(*(load.ratios(budget) for load in loads), strict=True)
    equal_s = [crossing_s(periods_s, ratios) for ratios in repetitions]
    return PeriodRange(min(equal_s), max(equal_s))


def crossing_s(periods_s: Sequence[float], ratios: Sequence[float]) -> float:
    """Return the period at which a ratio of computation is one, s.

    Between two periods the ratio is interpolated as a power of the period: exact for a constant step time, and close
    for a growing horizon.

    Args:
        periods_s: Periods from the longest to the shortest, (n,), s.
        ratios: Computation over the reference's, (n,).
    Returns: Infinite if the ratio exceeds one even at the longest period; 0 if it stays below one.
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
