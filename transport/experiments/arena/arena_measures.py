"""Measures of the arena, each with its number, its unit and its title; there is no score."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from transport.experiments.arena.arena_algorithms import REFERENCE
from transport.experiments.arena.arena_runs import FROM_GOAL, VIOLATION
from transport.experiments.simulation import Result
from transport.experiments.statistics import COST_RATIO, PointStatistics

_ARRIVED_M = 0.5
MISSED = "missed"  # outcome of a run to its end in which the payload does not arrive
MISSING = "-"  # text of a number that a point does not have


@dataclass(frozen=True, slots=True, kw_only=True)
class ArenaAxis:
    """A measure of the arena, with a table of its own, and a figure on request."""

    title: str
    number: str
    drawn: str  # name and unit in a figure
    factor: float = 1.0  # from the number to the unit
    digits: int = 2

    def text(self, one: PointStatistics) -> str:
        """Return the mean of a point, with interval or range if there are several runs."""
        if self.number != COST_RATIO and self.number not in one.numbers:
            return MISSING
        value = one.estimate(self.number)
        return MISSING if value is None else value.scaled(self.factor).text(self.digits)


# Measures by name.
MEASURES: Mapping[str, ArenaAxis] = {
    "cost": ArenaAxis(
        title=f"Mean cost over that of `{REFERENCE}` on a perfect network",
        number=COST_RATIO,
        drawn="cost over centralized",
    ),
    "error": ArenaAxis(
        title="Payload error, cm rms",
        number="payload_rms_m",
        drawn="payload error, cm rms",
        factor=100.0,
        digits=1,
    ),
    "distance": ArenaAxis(
        title="Smallest distance of two UAVs, m",
        number="separation_min_m",
        drawn="distance, m",
        digits=3,
    ),
    "violation": ArenaAxis(
        title="Largest violation of the shared constraint, N",
        number=VIOLATION,
        drawn="violation, N",
    ),
    "plans": ArenaAxis(
        title="Plans of the team to each other, kB/s",
        number="plan_bytes_per_s",
        drawn="plans, kB/s",
        factor=1e-3,
        digits=1,
    ),
    "airtime": ArenaAxis(
        title="Airtime of the radio, %, 20 % of it traffic of others",
        number="airtime_share",
        drawn="airtime, %",
        factor=100.0,
        digits=1,
    ),
    "step": ArenaAxis(
        title="Processor time of an agent's step, ms, median",
        number="cpu_step_p50_ms",
        drawn="step, ms",
    ),
}


def judged(result: Result) -> Result:
    """Return the result of a run, with the outcome `MISSED` where the payload does not arrive."""
    from_goal_m = result.numbers.get(FROM_GOAL)
    if result.outcome != "completed" or from_goal_m is None or from_goal_m <= _ARRIVED_M:
        return result
    return replace(
        result, outcome=MISSED, reason=f"the payload ends {from_goal_m:.2f} m from its goal"
    )
