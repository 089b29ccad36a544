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

from transport.experiments.experiment import Axis
from transport.experiments.statistics import PointStatistics
from transport.report.style import WIDTH_IN, label_decades

_ACROSS = 2  # maps side by side
_CELL_IN, _AROUND_IN = 0.46, 0.85
_PRINT = 7.0
_COLOURS = "viridis"

# A cell without a completed run.
_DIVERGED: dict[str, Any] = {"facecolor": "#e3e3e3", "edgecolor": "#ffffff", "hatch": "////", "linewidth": 1.0}
_LIGHT, _DARK = "#ffffff", "#000000"
_MIDDLE = 0.55  # text is light below this share of the colour scale


def draw_maps(figure: Figure, x: Axis, y: Axis, measured: Sequence[PointStatistics]) -> None:
    """Draw a map of two axes for each scenario, with one colour scale."""
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    down, across = math.ceil(len(scenarios) / _ACROSS), min(len(scenarios), _ACROSS)
    rows = len({m.point.labels[y.label] for m in measured})
    figure.set_size_inches(WIDTH_IN, down * (_CELL_IN * rows + _AROUND_IN))
    panels = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
    costs = [value.mean for m in measured if (value := m.numbers["cost_mean"]) is not None and value.mean > 0.0]
    low, high = (1e3 * min(costs), 1e3 * max(costs)) if costs else (1.0, 1.0)
    high = max(high, 1.001 * low)
    for axes, scenario in zip(panels.flat, scenarios, strict=False):
        _draw_map(axes, x, y, [m for m in measured if m.point.scenario == scenario], low, high)
        axes.set_title(scenario)
    for axes in panels.flat[len(scenarios) :]:
        axes.set_visible(False)
    for axes in panels[-1]:
        axes.set_xlabel(x.title)
    for axes in panels[:, 0]:
        axes.set_ylabel(y.title)
    scale = ScalarMappable(LogNorm(low, high), _COLOURS)
    bar = figure.colorbar(scale, ax=panels, label="mean cost ($10^{-3}$)", pad=0.02, aspect=25)
    label_decades(bar.ax.yaxis)
    bar.outline.set_visible(False)


def _draw_map(axes: Axes, x: Axis, y: Axis, measured: Sequence[PointStatistics], low: float, high: float) -> None:
    columns = sorted({float(m.point.labels[x.label]) for m in measured})
    rows = sorted({float(m.point.labels[y.label]) for m in measured})
    for m in measured:
        column, row = columns.index(float(m.point.labels[x.label])), rows.index(float(m.point.labels[y.label]))
        cost = m.numbers["cost_mean"]
        if cost is None:
            style, ink = _DIVERGED, _DARK
            text = f"div.\n{m.diverged_s[0]:.1f} s" if m.diverged_s else "-"
        else:
            value = 1e3 * cost.mean
            share = math.log(max(value, low) / low) / math.log(high / low)
            style = {"facecolor": mpl.colormaps[_COLOURS](share), "edgecolor": "#ffffff", "linewidth": 1.0}
            ink = _LIGHT if share < _MIDDLE else _DARK
            text = f"{value:.2f}" + (f"\n{m.completed}/{m.runs}" if m.completed < m.runs else "")
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, **style))
        axes.text(column, row, text, ha="center", va="center", color=ink, fontsize=_PRINT, linespacing=1.1)
    axes.set_xlim(-0.5, len(columns) - 0.5)
    axes.set_ylim(-0.5, len(rows) - 0.5)
    axes.set_xticks(range(len(columns)), [f"{x.factor * value:g}" for value in columns])
    axes.set_yticks(range(len(rows)), [f"{y.factor * value:g}" for value in rows])
    axes.tick_params(length=0.0)
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)
