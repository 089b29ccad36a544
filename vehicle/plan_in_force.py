"""The plan of one UAV that is in force at a time, by which its setpoints are interpolated."""

from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array
from transport.protocol.wire.messages import Plan

# Sources of a setpoint that is not from a plan, as in `PlantState.plan_ticks`.
BEFORE_ANY_PLAN = -1
OWN_LAW = -2
NONE = -3


@dataclass(frozen=True, slots=True, kw_only=True)
class Planned:
    """A plan of the UAV, and the time of its arrival, ns of a steady clock."""

    plan: Plan
    arrived_ns: int


class Plans:
    """Plans of one UAV whose inputs may be applied.

    played: Steps of a plan that are applied at most; later it is too old.
    """

    def __init__(self, played: int) -> None:
        self._played = played
        self._plans: list[Planned] = []

    def add(self, plan: Plan, arrived_ns: int) -> None:
        """Add a plan, in any order of arrival."""
        self._plans.append(Planned(plan=plan, arrived_ns=arrived_ns))
        self._plans.sort(key=lambda one: (one.plan.start_tick, one.plan.tick))

    def at(self, ticks: float) -> tuple[Planned, Array] | None:
        """Return the plan in force at a time, in ticks, and its inputs then, (4,).

        None without one that has started and is fresh.
        """
        started = [one for one in self._plans if one.plan.start_tick <= ticks]
        if not started:
            return None
        newest = started[-1]
        self._plans = self._plans[self._plans.index(newest) :]
        steps = ticks - newest.plan.start_tick
        # A plan that repeats older inputs does not renew the time for which these are played.
        played = min(self._played, len(newest.plan.inputs))
        if steps + newest.plan.stale >= played:
            return None
        return newest, interpolated(newest.plan.inputs, steps)


def interpolated(inputs: Array, steps: float) -> Array:
    """Return inputs that are held over steps, (K, 4), at a time in steps, (4,).

    Linear between the middles of the steps, where they are the inputs themselves: their mean over a
    step inside changes by the curvature alone, so that nothing is applied earlier or later.
    """
    middle = steps - 0.5
    first = int(np.floor(middle))
    share = middle - first
    before = inputs[min(max(first, 0), len(inputs) - 1)]
    after = inputs[min(max(first + 1, 0), len(inputs) - 1)]
    between: Array = (1.0 - share) * before + share * after
    return between
