"""Maps of two quantities, one for each scenario: cost as colour, completed runs as numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from transport.experiments.declaration import Axis
from transport.experiments.statistics import PointStatistics
from transport.report.column import Room, column_panels, head
from transport.report.style import COLUMN_IN, SMALL, TEXT, label_decades

# Height of a row and of a map, room above a map and beside it, distance and width of the colour bar, in.
_ROW_IN = 0.27
_LEAST_IN = 1.05  # the vertical axis has its title
_ABOVE_IN = 0.2
_RIGHT_IN = 0.42
_BAR_GAP_IN = 0.08
_BAR_IN = 0.09
# Costs are shown in thousandths; the scale spans at least this ratio.
_THOUSANDTHS = 1e3
_LEAST_SPAN = 1.001
# Numbers are white on the dark colours, below this share of the scale.
_DARK = 0.55
_BEHIND = {"hatch": "////", "edgecolor": "#c8c8c8", "linewidth": 0.0}
_ON_HATCH = {"facecolor": "#ffffff", "edgecolor": "none", "pad": 0.6}
_POINTS_PER_IN = 72.0


def draw_maps(
    figure: Figure, x: Axis, y: Axis, scenarios: Mapping[str, Sequence[PointStatistics]]
) -> None:
    """Draw a map of two axes for each scenario, one below another, with one colour scale."""
    measured = [statistics for own in scenarios.values() for statistics in own]
    columns = _values(measured, x)
    rows = _values(measured, y)
    scale = _scale(measured)

    heights_in = [max(_ROW_IN * len(rows), _LEAST_IN)] * len(scenarios)
    room = Room(right_in=_RIGHT_IN, top_in=_ABOVE_IN)
    panels = column_panels(figure, heights_in, x_label=x.title, room=room)
    for panel, (scenario, own) in zip(panels, scenarios.items(), strict=True):
        costs = np.full((len(rows), len(columns)), np.nan)
        for statistics in own:
            column = columns.index(float(statistics.point.labels[x.label]))
            row = rows.index(float(statistics.point.labels[y.label]))
            costs[row, column] = _draw_cell(panel, (column, row), statistics, scale)

        panel.patch.set(**_BEHIND)  # behind cells without a completed run
        panel.imshow(costs, norm=scale, aspect="auto", origin="lower")
        head(panel, scenario, legend=False)
        panel.set_xticks(range(len(columns)), [f"{x.factor * value:g}" for value in columns])
        panel.set_yticks(range(len(rows)), [f"{y.factor * value:g}" for value in rows])
        panel.set_ylabel(y.title)
        panel.tick_params(length=0.0)
        panel.grid(visible=False)
    _draw_scale(figure, panels, scale)


def _values(measured: Sequence[PointStatistics], axis: Axis) -> list[float]:
    """Return the values along an axis in increasing order."""
    return sorted({float(statistics.point.labels[axis.label]) for statistics in measured})


def _scale(measured: Sequence[PointStatistics]) -> LogNorm:
    """Return a logarithmic scale over all costs above zero."""
    means = [statistics.mean("cost_mean") for statistics in measured]
    costs = [_THOUSANDTHS * mean for mean in means if mean] or [1.0]
    return LogNorm(min(costs), max(max(costs), _LEAST_SPAN * min(costs)))


def _draw_cell(
    panel: Axes, place: tuple[int, int], statistics: PointStatistics, scale: LogNorm
) -> float:
    """Write the text of a cell at a column and row.

    Returns: Its cost, nan without a completed run.
    """
    style: dict[str, Any] = {
        "ha": "center",
        "va": "center",
        "fontsize": SMALL,
        "linespacing": 1.0,
    }
    mean = statistics.mean("cost_mean")
    if mean is None:
        text = f"diverges\n{statistics.diverged_s[0]:.1f} s" if statistics.diverged_s else "-"
        panel.text(*place, text, bbox=_ON_HATCH, **style)
        return float("nan")

    cost = _THOUSANDTHS * mean
    text = f"{cost:.2f}"
    if statistics.completed < statistics.runs:
        text += f"\n{statistics.completed} of {statistics.runs}"
    lowest = cost if scale.vmin is None else scale.vmin
    shown = max(cost, lowest)  # a cost of zero has no logarithm
    panel.text(*place, text, color="#ffffff" if scale(shown) < _DARK else "#000000", **style)
    return shown


def _draw_scale(figure: Figure, panels: Sequence[Axes], scale: LogNorm) -> None:
    """Draw the colour bar to the right of all maps."""
    first = panels[0].get_position()
    bottom = panels[-1].get_position().y0
    left = first.x1 + _BAR_GAP_IN / COLUMN_IN
    bar_place = (left, bottom, _BAR_IN / COLUMN_IN, first.y1 - bottom)
    bar = figure.colorbar(ScalarMappable(scale), cax=figure.add_axes(bar_place))
    label_decades(bar.ax.yaxis)

    above = first.y1 + 2.0 / _POINTS_PER_IN / figure.get_figheight()
    figure.text(0.99, above, "mean cost ($10^{-3}$)", ha="right", va="bottom", fontsize=TEXT)
