"""Plots beside the scene: payload error, stage cost, ages of plans and thrust over time, drawn by the browser."""

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from model.arrays import Array
from transport.scene.colours import uav_style
from transport.scene.curves import CurveReader
from transport.scene.scene import SceneBuilder

if TYPE_CHECKING:
    import viser

# Time axis of a live run, s; points of a curve; shortest time between two updates of the plots of a live run, s.
_LIVE_S, _POINTS, _UPDATE_S = 30.0, 200, 0.5
_HEIGHT_PX = 120
# Smaller costs are rounding errors.
_LEAST_COST = 1e-8


class Plots:
    """Four plots in the panel of the viewer; lines have the colours of the UAVs.

    Args:
        gui: Panel, in the folder that is open.
        builder: Scenes of the run.
        is_live: Whether the run is active: the plots then show the last seconds.
    """

    def __init__(self, gui: "viser.GuiApi", builder: SceneBuilder, *, is_live: bool) -> None:
        setup = builder.setup
        self._reader, self._is_live = CurveReader(builder), is_live
        self._duration_s = setup.ticks * setup.settings.sampling_period_s
        self._updated_s = -_UPDATE_S
        agents = [uav_style(owned[0])["color"] for owned in setup.owned]
        uavs = [uav_style(i)["color"] for i in range(setup.system.N)]
        self._error = self._add(gui, "payload error (m)", ["#000000"])
        self._cost = self._add(gui, "stage cost (power of ten)", ["#000000"])
        self._ages = self._add(gui, "oldest plan in use, by agent (s)", agents)
        self._thrusts = self._add(gui, "thrust, by UAV (N)", uavs)

    def show(self, tick: int) -> None:
        """Show the curves until a tick; of a live run at most every `_UPDATE_S` seconds."""
        now_s = time.monotonic()
        if self._is_live and now_s - self._updated_s < _UPDATE_S:
            return
        self._updated_s = now_s
        curves = self._reader.until(tick, _LIVE_S if self._is_live else self._duration_s, _POINTS)
        t = curves.times_s
        for plot, values in (
            (self._error, curves.error_m[None]),
            (self._cost, np.log10(np.maximum(curves.cost, _LEAST_COST))[None]),
            (self._ages, curves.ages_s),
            (self._thrusts, curves.thrusts_N),
        ):
            _set_data(plot, t, values)

    def _add(self, gui: "viser.GuiApi", title: str, colours: list[str]) -> Any:
        series: list[Any] = [{"label": "time (s)"}, *({"stroke": colour, "width": 1.5} for colour in colours)]
        scales: dict[str, Any] = {"x": {"time": False}}
        if not self._is_live:
            scales["x"] |= {"auto": False, "range": [0.0, self._duration_s]}
        axes: list[Any] = [{"size": 26, "font": "10px sans-serif"}, {"size": 46, "font": "10px sans-serif"}]
        empty = (np.array([0.0, 1.0]), *(np.zeros(2) for _ in colours))
        return gui.add_uplot(
            empty,
            tuple(series),
            title=title,
            scales=scales,
            axes=tuple(axes),
            legend={"show": False},
            cursor={"show": False},
            height=_HEIGHT_PX,
        )


def _set_data(plot: Any, t: Array, values: Array) -> None:
    """Set the curves of a plot, (k, T), over times, (T,), s."""
    plot.data = (np.asarray(t), *(np.ascontiguousarray(row) for row in values))
