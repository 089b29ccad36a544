"""Plots beside the scene: payload error, stage cost, ages of plans and thrust over time, drawn by the browser."""

import time
from typing import Any

import numpy as np

from model.arrays import Array
from model.state import INPUTS
from transport.scene.drawing import uav_style
from transport.scene.scene import SceneBuilder

# Time axis of a live run, s; points of a curve; shortest time between two updates of the plots of a live run, s.
_LIVE_S, _POINTS, _UPDATE_S = 30.0, 200, 0.5
_HEIGHT_PX = 120
# Smaller costs are rounding errors.
_LEAST_COST = 1e-8
# Opacity, two hexadecimal digits, of the part of a recorded run after the shown tick.
_FADED = "48"


class Plots:
    """Four plots in the panel of the viewer; lines have the colours of the UAVs.

    Those of a recorded run show the whole run, faded after the shown tick; those of a live run the seconds before it,
    by the time before it, since the browser does not move a time axis with its data.
    """

    def __init__(self, gui: Any, builder: SceneBuilder, *, is_live: bool) -> None:
        setup, history = builder.setup, builder.history
        self._builder, self._is_live, self._period_s = builder, is_live, setup.settings.sampling_period_s
        self._updated_s = -_UPDATE_S
        self._rows: dict[int, list[Array]] = {}  # by tick
        self._whole = None if is_live or history.last < 0 else self._between(0, history.last)
        agents = [uav_style(owned[0])["color"] for owned in setup.owned]
        uavs = [uav_style(i)["color"] for i in range(setup.system.N)]
        # Title, colours, and the least range of the axis: that of a single value would be any.
        kinds: tuple[tuple[str, list[str], tuple[float, float]], ...] = (
            ("payload error (m)", ["#000000"], (0.0, 0.01)),
            ("stage cost (power of ten)", ["#000000"], (-6.0, -3.0)),
            ("oldest plan in use, by agent (s)", agents, (0.0, 2.0 * self._period_s)),
            ("thrust, by UAV (N)", uavs, (0.98 * builder.hover_N, 1.02 * builder.hover_N)),
        )
        self._plots = [self._add(gui, number, *kind) for number, kind in enumerate(kinds)]

    def show(self, tick: int) -> None:
        """Show the curves at a tick; of a live run at most every `_UPDATE_S` seconds."""
        now_s = time.monotonic()
        if self._is_live and now_s - self._updated_s < _UPDATE_S:
            return
        self._updated_s = now_s
        for plot, data in zip(self._plots, self._data(tick), strict=True):
            plot.data = data

    def _data(self, tick: int) -> list[tuple[Array, ...]]:
        """Return times, s, and curves of each plot."""
        if self._whole is None:
            ticks, parts = self._between(tick - round(_LIVE_S / self._period_s), tick)
            return [((ticks - tick) * self._period_s, *map(np.ascontiguousarray, part)) for part in parts]
        ticks, parts = self._whole
        t = ticks * self._period_s
        return [(t, *part.copy(), *np.where(ticks <= tick, part, np.nan)) for part in parts]

    def _between(self, first: int, last: int) -> tuple[Array, list[Array]]:
        """Return ticks, (T,), until the last, which is recorded, and the curves of each plot, (curves, T) each."""
        recorded = self._builder.history.plant_states
        first = max(self._builder.history.first, first)
        # Multiples of the spacing, so that the same ticks are drawn again, and the last.
        every = max(1, (last - first) // _POINTS)
        ticks = [k for k in range(first - first % every, last, every) if k in recorded] + [last]
        return np.array(ticks), [np.array(part).T for part in zip(*map(self._row, ticks), strict=True)]

    def _row(self, tick: int) -> list[Array]:
        """Return the values of each plot at a tick: m, power of ten, s, N."""
        if tick not in self._rows:
            setup, history = self._builder.setup, self._builder.history
            error_m, cost = self._builder.error_and_cost(tick)
            reports = [history.reports.get((agent, tick)) for agent in setup.agents]
            ages = [0 if report is None else max([0, *report.plan_ages]) for report in reports]
            decade = np.log10(max(cost, _LEAST_COST))
            thrusts_N = history.plant_states[tick].u[::INPUTS]
            self._rows[tick] = [np.array([error_m]), np.array([decade]), np.array(ages) * self._period_s, thrusts_N]
        return self._rows[tick]

    def _add(self, gui: Any, number: int, title: str, colours: list[str], least: tuple[float, float]) -> Any:
        low, high = least
        if self._whole is None:
            label, span_s = "time before the shown tick (s)", [-_LIVE_S, 0.0]
            data = (np.array(span_s), *(np.full(2, np.nan) for _ in colours))
            # A range in uPlot's words: wider where the curves are.
            ends = zip(("min", "max"), least, strict=True)
            range_y: Any = {end: {"pad": 0.1, "soft": soft, "mode": 1} for end, soft in ends}
        else:
            data, part = self._data(0)[number], self._whole[1][number]
            label, span_s = "time (s)", [0.0, max(float(data[0][-1]), self._period_s)]
            colours = [*(colour + _FADED for colour in colours), *colours]
            finite = part[np.isfinite(part)]
            low, high = min([low, *finite]), max([high, *finite])
            range_y = [low - 0.05 * (high - low), high + 0.05 * (high - low)]
        return gui.add_uplot(
            data,
            ({"label": label}, *({"stroke": colour, "width": 1.5} for colour in colours)),
            title=title,
            scales={"x": {"time": False, "auto": False, "range": span_s}, "y": {"range": range_y}},
            axes=tuple({"size": size, "font": "10px sans-serif"} for size in (26, 46)),
            legend={"show": False},
            cursor={"show": False},
            height=_HEIGHT_PX,
        )
