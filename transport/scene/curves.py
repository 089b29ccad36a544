"""Quantities of a run over time, tick by tick as its history grows: error, cost, ages of plans, thrust."""

from dataclasses import dataclass

import numpy as np

from model.arrays import Array
from model.state import INPUTS
from transport.scene.scene import SceneBuilder


@dataclass(frozen=True, slots=True, kw_only=True)
class Curves:
    """Values at T ticks of a run with N UAVs and A agents.

    Attributes:
        times_s: (T,), s.
        error_m: Distance of the payload from its reference, (T,), m.
        cost: Stage cost, (T,).
        ages_s: Age of the oldest plan that each agent used, (A, T), s; 0 for an agent that used none.
        thrusts_N: Thrust of each UAV, (N, T), N.
    """

    times_s: Array
    error_m: Array
    cost: Array
    ages_s: Array
    thrusts_N: Array


class CurveReader:
    """Reader of the curves of one run; a tick is computed once."""

    def __init__(self, builder: SceneBuilder) -> None:
        self._builder = builder
        self._rows: dict[int, tuple[float, float, Array, Array]] = {}

    def until(self, tick: int, window_s: float, points: int) -> Curves:
        """Return the curves of the last seconds until a tick, with at most about so many points."""
        period_s = self._builder.setup.settings.sampling_period_s
        ticks = max(1, round(window_s / period_s))
        every = max(1, ticks // points)
        # Multiples of the spacing, so that the same ticks are drawn again, and the newest.
        first = max(self._builder.history.first, tick - ticks)
        recorded = self._builder.history.plant_states
        chosen = [k for k in range(first - first % every, tick, every) if k in recorded]
        rows = [self._row(k) for k in [*chosen, tick]]
        return Curves(
            times_s=np.array([*chosen, tick], dtype=float) * period_s,
            error_m=np.array([row[0] for row in rows]),
            cost=np.array([row[1] for row in rows]),
            ages_s=np.array([row[2] for row in rows]).T,
            thrusts_N=np.array([row[3] for row in rows]).T,
        )

    def _row(self, tick: int) -> tuple[float, float, Array, Array]:
        if tick not in self._rows:
            setup, history = self._builder.setup, self._builder.history
            error_m, cost = self._builder.error_and_cost(tick)
            reports = [history.report(agent, tick) for agent in setup.agents]
            ages = [0 if report is None else max([0, *report.plan_ages]) for report in reports]
            thrusts_N = history.plant_states[tick].u[::INPUTS]
            self._rows[tick] = error_m, cost, np.array(ages) * setup.settings.sampling_period_s, thrusts_N
        return self._rows[tick]
