"""Plots beside the scene: payload error, stage cost, ages of plans and thrust over time, drawn by the browser."""

from functools import lru_cache
from typing import Any

import numpy as np

from model.arrays import Array
from model.state import INPUTS
from transport.scene.drawing import uav_style
from transport.scene.scene import SceneBuilder

# Time axis, s; points of a curve.
_SPAN_S, _POINTS = 30.0, 200
_HEIGHT_PX = 120
# Smaller costs are rounding errors.
_LEAST_COST = 1e-8


class Plots:
    """Four plots in the panel of the viewer; lines have the colours of the UAVs.

    They show the seconds before the shown tick, by the time before it, as the browser does not move a time axis with
    its data.
    """

    def __init__(self, gui: Any, builder: SceneBuilder) -> None:
        setup = builder.setup
        self._builder, self._period_s = builder, setup.settings.sampling_period_s
        self._row = lru_cache(10 * _POINTS)(self._values)
        agents = [uav_style(owned[0])["color"] for owned in setup.owned]
        uavs = [uav_style(i)["color"] for i in range(setup.system.N)]
        # Title, colours, and the least range of the axis: that of a single value would be any.
        kinds: tuple[tuple[str, list[str], tuple[float, float]], ...] = (
            ("payload error (m)", ["#000000"], (0.0, 0.01)),
            ("stage cost (power of ten)", ["#000000"], (-6.0, -3.0)),
            ("oldest plan in use, by agent (s)", agents, (0.0, 2.0 * self._period_s)),
            ("thrust, by UAV (N)", uavs, (0.98 * builder.hover_N, 1.02 * builder.hover_N)),
        )
        self._plots = [_plot(gui, *kind) for kind in kinds]

    def show(self, tick: int) -> None:
        """Show the curves until a recorded tick."""
        recorded = self._builder.history.plant_states
        first = max(self._builder.history.first, tick - round(_SPAN_S / self._period_s))
        # Multiples of the spacing, so that the same ticks are drawn again, and the last.
        every = max(1, (tick - first) // _POINTS)
        ticks = [k for k in range(first - first % every, tick, every) if k in recorded] + [tick]
        times_s = (np.array(ticks) - tick) * self._period_s
        for plot, part in zip(self._plots, zip(*map(self._row, ticks), strict=True), strict=True):
            plot.data = times_s, *map(np.ascontiguousarray, np.array(part).T)

    def _values(self, tick: int) -> list[Array]:
        """Return the values of each plot at a tick: m, power of ten, s, N."""
        setup, history = self._builder.setup, self._builder.history
        error_m, cost = self._builder.error_and_cost(tick)
        reports = [history.reports.get((agent, tick)) for agent in setup.agents]
        ages = [0 if report is None else max([0, *report.plan_ages]) for report in reports]
        decade, thrusts_N = np.log10(max(cost, _LEAST_COST)), history.plant_states[tick].u[::INPUTS]
        return [np.array([error_m]), np.array([decade]), np.array(ages) * self._period_s, thrusts_N]


def _plot(gui: Any, title: str, colours: list[str], least: tuple[float, float]) -> Any:
    # A range in uPlot's words: wider where the curves are.
    range_y = {end: {"pad": 0.1, "soft": soft, "mode": 1} for end, soft in zip(("min", "max"), least, strict=True)}
    return gui.add_uplot(
        (np.array([-_SPAN_S, 0.0]), *(np.full(2, np.nan) for _ in colours)),
        ({"label": "time before the shown tick (s)"}, *({"stroke": colour, "width": 1.5} for colour in colours)),
        title=title,
        scales={"x": {"time": False, "auto": False, "range": [-_SPAN_S, 0.0]}, "y": {"range": range_y}},
        axes=tuple({"size": size, "font": "10px sans-serif"} for size in (26, 46)),
        legend={"show": False},
        cursor={"show": False},
        height=_HEIGHT_PX,
    )
