"""Scaling figure: computation, messages and cost over the number of UAVs, with reference slopes."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator

from transport.experiments.conclusions import FEWEST
from transport.experiments.curve_figure import draw_means
from transport.experiments.design_experiments import CENTRALIZED
from transport.experiments.statistics import PointStatistics
from transport.report.column import draw_legend, head, legend_height_in
from transport.report.style import COLUMN_IN, CURVES, REFERENCE, SMALL, label_decades

# Size of a panel; margins; gaps between panels, inches.
_WIDTH_IN, _HEIGHT_IN = 1.22, 1.15
_LEFT_IN, _ABOVE_IN, _BELOW_IN = 0.36, 0.18, 0.34
_BESIDE_IN, _BETWEEN_IN = 0.44, 0.34

# Room for the names of the slopes beyond the largest team, as a factor; smallest distance of two names, points.
_ROOM, _NAME_PT = 1.45, 7.5
# Margin of the vertical axes around means and slopes, as a factor; wide intervals, as of two runs, are cut off.
_MARGIN = 1.4
# Team sizes closer than this factor leave no room for both their names.
_CLOSE = 1.25
# Size of the markers of the first curve, and by how much it falls, so that curves that coincide stay visible.
_LARGEST, _SMALLER = 4.8, 1.2


class _Panel(NamedTuple):
    """Title, number, factor, and exponent of the reference slope by ownership."""

    title: str
    name: str
    factor: float
    slopes: Mapping[str, float]


class _Slope(NamedTuple):
    """A reference slope: exponent, and its upper end."""

    power: float
    end: float


_PANELS = (
    _Panel("agent's CPU per step (ms)", "cpu_step_p50_ms", 1.0, {"distributed": 1.5, CENTRALIZED: 3.0}),
    _Panel("team's CPU per tick (ms)", "cpu_team_tick_ms", 1.0, {"distributed": 2.5, CENTRALIZED: 3.0}),
    _Panel("plans sent (kB/s)", "plan_bytes_per_s", 1e-3, {"distributed": 2.0}),
    _Panel("mean cost ($10^{-3}$)", "cost_mean", 1e3, {}),
)


def draw_scaling(figure: Figure, measured: Sequence[PointStatistics]) -> None:
    """Draw four panels over the number of UAVs, with a curve for each ownership."""
    ownerships = list(dict.fromkeys(str(m.point.labels["ownership"]) for m in measured))
    styles = {name: _style(index) for index, name in enumerate(ownerships)}
    slope = Line2D([], [], label="power of N", color=REFERENCE, linestyle=":", linewidth=1.0)
    rows = {"": [*(Line2D([], [], label=name, **style) for name, style in styles.items()), slope]}
    panels = _panels(figure, legend_height_in(rows))
    draw_legend(figure, rows)
    sizes = sorted({int(m.point.labels["uavs"]) for m in measured})
    for axes, panel in zip(panels, _PANELS, strict=True):
        axes.set_xscale("log")
        axes.set_yscale("log")
        heights: list[float] = []
        slopes: list[_Slope] = []
        for name, style in styles.items():
            own = [m for m in measured if m.point.labels["ownership"] == name]
            drawn, along = _draw(axes, panel, own, name, style)
            heights += [*drawn, *(slope.end for slope in along)]
            slopes += along
        head(axes, panel.title, legend=False)
        axes.set_xlim(sizes[0] / _ROOM**0.3, sizes[-1] * (_ROOM if slopes else _ROOM**0.3))
        if heights:
            axes.set_ylim(min(heights) / _MARGIN, max(heights) * _MARGIN)
        label_decades(axes.yaxis)
        axes.set_xticks(sizes, _names(sizes))
        axes.xaxis.set_minor_locator(NullLocator())
        _name_slopes(axes, slopes, sizes[-1])
    for axes in panels[2:]:
        axes.set_xlabel("number of UAVs N")


def _panels(figure: Figure, legend_in: float) -> list[Axes]:
    """Return the panels, two in a row, of an empty figure, which gets its size."""
    rows = len(_PANELS) // 2
    height_in = legend_in + rows * (_ABOVE_IN + _HEIGHT_IN) + (rows - 1) * (_BETWEEN_IN - _ABOVE_IN) + _BELOW_IN
    figure.set_layout_engine("none")
    figure.set_size_inches(COLUMN_IN, height_in)
    found = []
    for index in range(len(_PANELS)):
        row, column = divmod(index, 2)
        left_in = _LEFT_IN + column * (_WIDTH_IN + _BESIDE_IN)
        bottom_in = _BELOW_IN + (rows - 1 - row) * (_HEIGHT_IN + _BETWEEN_IN)
        place = left_in / COLUMN_IN, bottom_in / height_in, _WIDTH_IN / COLUMN_IN, _HEIGHT_IN / height_in
        found.append(figure.add_axes(place))
        found[-1].tick_params(labelbottom=row == rows - 1)
    return found


def _style(index: int) -> dict[str, Any]:
    """Return the style of a curve."""
    colour, marker, line = CURVES[index % len(CURVES)]
    return {"color": colour, "marker": marker, "linestyle": line, "markersize": _LARGEST - _SMALLER * index}


def _names(sizes: Sequence[int]) -> list[str]:
    """Return the tick label of each size, ascending; empty where it would overlap the next."""
    names: list[str] = []
    named = math.inf
    for size in reversed(sizes):
        has_room = named > _CLOSE * size
        names.insert(0, str(size) if has_room else "")
        named = size if has_room else named
    return names


def _draw(
    axes: Axes, panel: _Panel, measured: Sequence[PointStatistics], name: str, style: dict[str, Any]
) -> tuple[list[float], list[_Slope]]:
    """Draw a curve with confidence intervals and its reference slope; return the means, and the slope."""
    shown = [m for m in measured if (value := m.numbers[panel.name]) is not None and value.mean > 0.0]
    if not shown:
        return [], []
    x = [int(m.point.labels["uavs"]) for m in shown]
    y = draw_means(axes, x, shown, panel.name, panel.factor, style)
    if name not in panel.slopes or x[-1] <= FEWEST:
        return y, []
    power = panel.slopes[name]
    first = next(i for i, uavs in enumerate(x) if uavs >= FEWEST)
    end = y[first] * (x[-1] / x[first]) ** power
    axes.plot([x[first], x[-1]], [y[first], end], color=REFERENCE, linestyle=":", linewidth=1.0, zorder=1.0)
    return y, [_Slope(power, end)]


def _name_slopes(axes: Axes, slopes: Sequence[_Slope], uavs: int) -> None:
    """Write the powers at the ends of the slopes, apart from one another."""
    low, high = axes.get_ylim()
    decade_pt = 72.0 * _HEIGHT_IN / math.log10(high / low)
    place_pt = math.inf
    for power, end in sorted(slopes, key=lambda slope: slope.end, reverse=True):
        own_pt = decade_pt * math.log10(end / low)
        place_pt = min(own_pt, place_pt - _NAME_PT)
        how: Any = {"textcoords": "offset points", "ha": "left", "va": "center", "color": "#555555", "fontsize": SMALL}
        axes.annotate(f"$N^{{{power:g}}}$", (uavs, end), (4.5, place_pt - own_pt), **how)
