"""Map figure of two varied quantities: cost as colour, completed runs as numbers."""

import math
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from transport.experiments.quantities import Axis
from transport.experiments.statistics import PointStatistics
from transport.report.column import column_panels, head
from transport.report.style import COLUMN_IN, SMALL, TEXT, label_decades

_CELL_IN, _ABOVE_IN = 0.27, 0.2
# Room at the right of the maps for the colour scale and its numbers.
_RIGHT_IN, _SCALE_IN = 0.42, 0.09
_COLOURS = "viridis"

# A cell without a completed run.
_DIVERGED: dict[str, Any] = {"facecolor": "#ffffff", "edgecolor": "#c8c8c8", "hatch": "////", "linewidth": 0.0}
_LIGHT, _DARK = "#ffffff", "#000000"
_MIDDLE = 0.55  # text is light below this share of the colour scale


def draw_maps(figure: Figure, x: Axis, y: Axis, measured: Sequence[PointStatistics]) -> None:
    """Draw a map of two axes for each scenario, one below another, with one colour scale."""
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    rows = len({m.point.labels[y.label] for m in measured})
    panels = column_panels(
        figure, [_CELL_IN * rows] * len(scenarios), x_label=x.title, right_in=_RIGHT_IN, top_in=_ABOVE_IN
    )
    costs = [value.mean for m in measured if (value := m.numbers["cost_mean"]) is not None and value.mean > 0.0]
    low, high = (1e3 * min(costs), 1e3 * max(costs)) if costs else (1.0, 1.0)
    high = max(high, 1.001 * low)
    for panel, scenario in zip(panels, scenarios, strict=True):
        _draw_map(panel, x, y, [m for m in measured if m.point.scenario == scenario], low, high)
        head(panel, scenario, legend=False)
        panel.set_ylabel(y.title)
    if costs:
        _draw_scale(figure, panels, low, high)


def _draw_scale(figure: Figure, panels: Sequence[Axes], low: float, high: float) -> None:
    """Draw the colour scale beside all maps."""
    bottom, top = panels[-1].get_position().y0, panels[0].get_position().y1
    left = panels[0].get_position().x1 + 0.08 / COLUMN_IN
    place = figure.add_axes((left, bottom, _SCALE_IN / COLUMN_IN, top - bottom))
    bar = figure.colorbar(ScalarMappable(LogNorm(low, high), _COLOURS), cax=place)
    label_decades(bar.ax.yaxis)
    title = "mean cost ($10^{-3}$)"
    figure.text(0.99, top + 2.0 / 72.0 / figure.get_figheight(), title, ha="right", va="bottom", fontsize=TEXT)
    bar.outline.set_visible(False)


def _draw_map(axes: Axes, x: Axis, y: Axis, measured: Sequence[PointStatistics], low: float, high: float) -> None:
    columns = sorted({float(m.point.labels[x.label]) for m in measured})
    rows = sorted({float(m.point.labels[y.label]) for m in measured})
    for m in measured:
        column, row = columns.index(float(m.point.labels[x.label])), rows.index(float(m.point.labels[y.label]))
        cost = m.numbers["cost_mean"]
        if cost is None:
            style, ink = _DIVERGED, _DARK
            text = f"diverges\n{m.diverged_s[0]:.1f} s" if m.diverged_s else "-"
        else:
            value = 1e3 * cost.mean
            share = math.log(max(value, low) / low) / math.log(high / low)
            style = {"facecolor": mpl.colormaps[_COLOURS](share), "edgecolor": "none"}
            ink = _LIGHT if share < _MIDDLE else _DARK
            text = f"{value:.2f}" + (f"\n{m.completed} of {m.runs}" if m.completed < m.runs else "")
        place = (column - 0.49, row - 0.48)
        axes.add_patch(Rectangle(place, 0.98, 0.96, **style))
        behind: Any = {"facecolor": "#ffffff", "edgecolor": "none", "pad": 0.6} if cost is None else None
        how: Any = {"ha": "center", "va": "center", "color": ink, "fontsize": SMALL, "linespacing": 1.0}
        axes.text(column, row, text, bbox=behind, **how)
    axes.set_xlim(-0.5, len(columns) - 0.5)
    axes.set_ylim(-0.5, len(rows) - 0.5)
    axes.set_xticks(range(len(columns)), [f"{x.factor * value:g}" for value in columns])
    axes.set_yticks(range(len(rows)), [f"{y.factor * value:g}" for value in rows])
    axes.tick_params(length=0.0)
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)
