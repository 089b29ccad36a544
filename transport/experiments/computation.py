"""Rates at which two controllers compute the same, from processor time measured side by side."""

import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from protocol.messages import Message, StepReport
from protocol.setup import Setup
from transport import memory

# Computation is measured at sampling periods that shrink by this factor, so many times at most, and interpolated
# between them. Periods are rounded to 0.1 ms.
SHRINK, MOST = math.sqrt(0.5), 8
_ROUNDED_TO_S = 1e-4

# Flights of each pair, one right after the other, and ticks of each that do not count: caches and solvers warm up.
REPEATS, WARM_UP = 3, 3

# What is flown for it: long enough to settle, short enough that a slow minute of the machine hits both of a pair.
MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]}]"
)
QUICK_MANEUVER = "maneuver.phase=[{name='climb',duration_s=0.4,displacement_m=[0,0,-0.2]}]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """What a controller computes compared to a reference.

    Attributes:
        controller: Which.
        kept: What of the reference's horizon it has: its "steps" or its "seconds".
        period_s: Its sampling period.
        horizon: N_p.
        agents: How many compute.
        step_ms: Processor time of an agent's step, mean.
        reference_step_ms: The same of the reference, right before.
        one_each: An agent's processor time per second of flight over the reference's.
    """

    controller: str
    kept: str
    period_s: float
    horizon: int
    agents: int
    step_ms: float
    reference_step_ms: float
    one_each: float

    @property
    def one_processor(self) -> float:
        """The whole team's processor time per second of flight over the reference's."""
        return self.agents * self.one_each

    def of(self, budget: str) -> float:
        """Computation over the reference's: of the team, if it shares "one processor", or of an agent, "one each"."""
        return self.one_processor if budget == "one processor" else self.one_each


def step_ms(setup: Setup) -> float:
    """Mean processor time of an agent's step on a flight, ms: estimate, linearise, discretise, condense, solve.

    Raises: ValueError: a flight that ends before anything can be measured.
    """
    times_ms: list[float] = []

    def record(message: Message) -> None:
        if isinstance(message, StepReport) and message.tick >= WARM_UP:
            times_ms.append(float(message.times_ms[-1]))

    control = memory.fly(setup, record, time.thread_time_ns)
    if not times_ms:
        raise ValueError(f"expected a flight of more than {WARM_UP} ticks, got {control.outcome}: {control.reason}")
    return statistics.fmean(times_ms)


def compared(
    reference: Setup,
    candidate: Setup,
    controller: str,
    kept: str,
    *,
    repeats: int = REPEATS,
    measure: Callable[[Setup], float] = step_ms,
) -> Load:
    """Fly reference and candidate in turns, and compare what they compute; the median of the repetitions' ratios.

    Args:
        reference: Flight of the controller that is compared to.
        candidate: Flight of the other.
        controller: What it is called.
        kept: Of the reference's horizon.
        repeats: Flights of each.
        measure: Processor time of an agent's step, ms.
    """
    pairs = [(measure(reference), measure(candidate)) for _ in range(repeats)]
    rate = reference.settings.sampling_period_s / candidate.settings.sampling_period_s
    return Load(
        controller=controller,
        kept=kept,
        period_s=candidate.settings.sampling_period_s,
        horizon=candidate.settings.horizon,
        agents=len(candidate.agents),
        step_ms=statistics.median(own for _, own in pairs),
        reference_step_ms=statistics.median(first for first, _ in pairs),
        one_each=rate * statistics.median(own / first for first, own in pairs),
    )


def faster_and_faster(load_at: Callable[[float], Load], longest_s: float) -> Iterator[Load]:
    """Loads at shorter and shorter periods, until each agent alone computes more than the reference.

    Args:
        load_at: Measures at a sampling period, s.
        longest_s: Where to begin.
    """
    for j in range(MOST + 1):
        load = load_at(_rounded(longest_s * SHRINK**j))
        yield load
        if load.one_each > 1.0:
            return


def equal_period_s(loads: Sequence[Load], budget: str) -> float | None:
    """Sampling period at which as much is computed as by the reference, s; None if no period is long enough.

    Between the two measured periods where computation passes the reference's it is taken to be a power of the period,
    which it is for a step that takes equally long, and nearly for one whose horizon grows.

    Args:
        loads: From the longest period to the shortest.
        budget: "one processor" for the whole team, or "one each".
    Returns: Not less than the shortest period measured; rounded up to 0.1 ms.
    """
    if not loads or loads[0].of(budget) > 1.0:
        return None
    for longer, shorter in itertools.pairwise(loads):
        low, high = math.log(longer.of(budget)), math.log(shorter.of(budget))
        if high > 0.0:
            share = -low / (high - low)
            period_s = longer.period_s * (shorter.period_s / longer.period_s) ** share
            return _rounded(period_s)
    return loads[-1].period_s


def _rounded(period_s: float) -> float:
    """A period rounded up to whole tenths of a millisecond."""
    return math.ceil(period_s / _ROUNDED_TO_S - 1e-6) / round(1.0 / _ROUNDED_TO_S)
