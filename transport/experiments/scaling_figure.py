"""Scaling figure: computation, messages and cost over the number of UAVs, with reference slopes."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from transport.experiments.curve_figure import PRINT, curve_style, draw_legend, draw_means
from transport.experiments.scaling import CENTRALIZED, FEWEST
from transport.experiments.statistics import PointStatistics
from transport.report.style import REFERENCE, WIDTH_IN, label_decades

_HEIGHT_IN = 4.6

# Room for the names of the slopes beyond the largest team, as a factor.
_ROOM = 1.3
# Margin of the vertical axes around means and slopes, as a factor; wide intervals, as of two runs, are cut off.
_MARGIN = 1.4
# Team sizes closer than this factor leave no room for both their names.
_CLOSE = 1.25


class _Panel(NamedTuple):
    """Title, number, factor, and exponent of the reference slope by ownership."""

    title: str
    name: str
    factor: float
    slopes: Mapping[str, float]


_PANELS = (
    _Panel("CPU, agent's step (ms)", "cpu_step_p50_ms", 1.0, {"distributed": 1.5, CENTRALIZED: 3.0}),
    _Panel("CPU, team per tick (ms)", "cpu_team_tick_ms", 1.0, {"distributed": 2.5, CENTRALIZED: 3.0}),
    _Panel("plans between agents (kB/s)", "plan_bytes_per_s", 1e-3, {"distributed": 2.0}),
    _Panel("mean cost ($10^{-3}$)", "cost_mean", 1e3, {}),
)


def draw_scaling(figure: Figure, measured: Sequence[PointStatistics]) -> None:
    """Draw four panels over the number of UAVs, with a curve for each ownership."""
    figure.set_size_inches(WIDTH_IN, _HEIGHT_IN)
    panels = figure.subplots(2, 2, sharex=True)
    ownerships = list(dict.fromkeys(m.point.labels["ownership"] for m in measured))
    sizes = sorted({int(m.point.labels["uavs"]) for m in measured})
    for axes, panel in zip(panels.flat, _PANELS, strict=True):
        axes.set_xscale("log")
        heights: list[float] = []
        for index, ownership in enumerate(ownerships):
            own = [m for m in measured if m.point.labels["ownership"] == ownership]
            heights += _draw(axes, panel, own, str(ownership), index)
        axes.set_title(panel.title)
        axes.set_yscale("log")
        if heights:
            axes.set_ylim(min(heights) / _MARGIN, max(heights) * _MARGIN)
        label_decades(axes.yaxis)
        axes.set_xticks(sizes, _names(sizes))
        axes.xaxis.set_minor_locator(NullLocator())
    for axes in panels[-1]:
        axes.set_xlabel("UAVs")
        axes.set_xlim(sizes[0] / _ROOM**0.3, sizes[-1] * _ROOM)
    draw_legend(figure, panels[0, 0])


def _names(sizes: Sequence[int]) -> list[str]:
    """Return the tick label of each size, ascending; empty where it would overlap the next."""
    names: list[str] = []
    named = math.inf
    for size in reversed(sizes):
        has_room = named > _CLOSE * size
        names.insert(0, str(size) if has_room else "")
        named = size if has_room else named
    return names


def _draw(axes: Axes, panel: _Panel, measured: Sequence[PointStatistics], name: str, index: int) -> list[float]:
    """Draw a curve with confidence intervals and its reference slope; return the values to be visible."""
    shown = [m for m in measured if (value := m.numbers[panel.name]) is not None and value.mean > 0.0]
    if not shown:
        return []
    x = [int(m.point.labels["uavs"]) for m in shown]
    y = draw_means(axes, x, shown, panel.name, panel.factor, {**curve_style(index), "label": name})
    if name in panel.slopes and x[-1] > FEWEST:
        power = panel.slopes[name]
        first = next(i for i, uavs in enumerate(x) if uavs >= FEWEST)
        end = y[first] * (x[-1] / x[first]) ** power
        axes.plot([x[first], x[-1]], [y[first], end], color=REFERENCE, linestyle=":", linewidth=1.0, zorder=1.0)
        how: Any = {"textcoords": "offset points", "ha": "left", "va": "center", "color": REFERENCE}
        axes.annotate(f"$N^{{{power:g}}}$", (x[-1], end), (5.0, 0.0), **how, fontsize=PRINT)
        return [*y, end]
    return y
