"""Maps of two quantities, one for each scenario: a number as colour and text, and completed runs."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from transport.experiments.declaration import Axis
from transport.experiments.statistics import PointStatistics
from transport.model.arrays import Array
from transport.report.figures.column import Room, column_panels, head
from transport.report.figures.style import COLUMN_IN, SMALL, TEXT, label_decades

# Height of a row and of a row with a name, of a map, room above a map and beside it, beside names,
# distance and width of the colour bar, in.
_ROW_IN = 0.27
_NAMED_ROW_IN = 0.2
_LEAST_IN = 1.05  # the vertical axis has its title
_ABOVE_IN = 0.2
_RIGHT_IN = 0.42
_NAMES_IN = 1.15
_BELOW_NAMES_IN = 0.45
_BAR_GAP_IN = 0.08
_BAR_IN = 0.09
_LEAST_SPAN = 1.001  # of the scale, at least this ratio
_DECADES = 3.0  # of the scale below its end at most: less is no difference
_FEW_DIGITS = 10.0  # numbers from here on have one decimal
# Numbers are white on the dark colours, below this share of the scale.
_DARK = 0.55
_BEHIND: Any = {"hatch": "////", "edgecolor": "#c8c8c8", "linewidth": 0.0}
_ON_HATCH = {"facecolor": "#ffffff", "edgecolor": "none", "pad": 0.6}
_POINTS_PER_IN = 72.0


def draw_maps(
    figure: Figure,
    x: Axis,
    y: Axis,
    shown: Axis,
    scenarios: Mapping[str, Sequence[PointStatistics]],
) -> None:
    """Draw a map of two axes for each scenario, one below another, with one colour scale.

    Names along an axis have their order, the first row at the top. A combination without a point is blank.
    """
    measured = [statistics for own in scenarios.values() for statistics in own]
    columns = _values(measured, x)
    rows = _values(measured, y)
    scale = _scale(measured, shown)

    is_named = isinstance(rows[0], str)
    row_in = _NAMED_ROW_IN if is_named else _ROW_IN
    heights_in = [max(row_in * len(rows), _LEAST_IN)] * len(scenarios)
    room = Room(right_in=_RIGHT_IN, top_in=_ABOVE_IN)
    if is_named:
        room = replace(room, left_in=_NAMES_IN, bottom_in=_BELOW_NAMES_IN)
    panels = column_panels(figure, heights_in, x_label=x.title, room=room)

    for panel, (scenario, own) in zip(panels, scenarios.items(), strict=True):
        cells = {}
        for statistics in own:
            labels = statistics.point.labels
            cells[columns.index(labels[x.label]), rows.index(labels[y.label])] = statistics
        values = _draw_cells(panel, cells, (len(rows), len(columns)), (shown, scale))
        panel.patch.set(facecolor="none")
        panel.imshow(values, norm=scale, aspect="auto", origin="upper" if is_named else "lower")
        head(panel, scenario, legend=False)
        _label_axes(panel, (x, columns), (y, rows))
    _draw_scale(figure, panels, (shown, scale))


def _label_axes(
    panel: Axes, along: tuple[Axis, list[str | float]], up: tuple[Axis, list[str | float]]
) -> None:
    """Label the columns and rows of a map: an axis and its values each."""
    x, columns = along
    names = [_tick(x, value).replace(" ", "\n") for value in columns]
    panel.set_xticks(range(len(columns)), names, fontsize=SMALL)

    y, rows = up
    is_named = isinstance(rows[0], str)
    panel.set_yticks(range(len(rows)), [_tick(y, value) for value in rows])
    panel.set_ylabel("" if is_named else y.title)  # names say by themselves what they are
    panel.tick_params(length=0.0)
    panel.grid(visible=False)


def _values(measured: Sequence[PointStatistics], axis: Axis) -> list[str | float]:
    """Return the values along an axis: numbers in increasing order, names in theirs."""
    values = list(dict.fromkeys(statistics.point.labels[axis.label] for statistics in measured))
    numbers = [value for value in values if not isinstance(value, str)]
    return values if len(numbers) < len(values) else [*sorted(numbers)]


def _tick(axis: Axis, value: str | float) -> str:
    return value if isinstance(value, str) else f"{axis.factor * value:g}"


def _scale(measured: Sequence[PointStatistics], shown: Axis) -> LogNorm:
    """Return a logarithmic scale over all numbers above zero, of `_DECADES` at most."""
    means = [statistics.mean(shown.label) for statistics in measured]
    values = [shown.factor * mean for mean in means if mean] or [1.0]
    most = max(max(values), _LEAST_SPAN * min(values))
    return LogNorm(max(min(values), most / 10.0**_DECADES), most)


def _draw_cells(
    panel: Axes,
    cells: Mapping[tuple[int, int], PointStatistics],
    shape: tuple[int, int],
    shown: tuple[Axis, LogNorm],
) -> Array:
    """Write the texts of cells by column and row; return their numbers (rows, columns), nan where none is."""
    values = np.full(shape, np.nan)
    for (column, row), statistics in cells.items():
        values[row, column] = _draw_cell(panel, (column, row), statistics, shown)
    return values


def _draw_cell(
    panel: Axes,
    place: tuple[int, int],
    statistics: PointStatistics,
    shown: tuple[Axis, LogNorm],
) -> float:
    """Write the text of a cell at a column and row; hatch one without a completed run.

    Returns: Its number, nan without one.
    """
    axis, scale = shown
    style: dict[str, Any] = {
        "ha": "center",
        "va": "center",
        "fontsize": SMALL,
        "linespacing": 1.0,
    }
    mean = statistics.mean(axis.label)
    # Where some runs collide, the distance of the others says little.
    is_told_by_number = axis.label == "cost_mean" or statistics.completed == statistics.runs
    if mean is None or not is_told_by_number:
        column, row = place
        panel.add_patch(
            Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, facecolor="#ffffff", **_BEHIND)
        )
        text = f"ends at\n{statistics.diverged_s[0]:.1f} s" if statistics.diverged_s else "-"
        if mean is not None:
            text = f"{statistics.completed} of {statistics.runs}"
        panel.text(*place, text, bbox=_ON_HATCH, **style)
        return float("nan")

    value = axis.factor * mean
    text = f"{value:.2f}" if value < _FEW_DIGITS else f"{value:.1f}"
    if statistics.completed < statistics.runs:
        text += f"\n{statistics.completed} of {statistics.runs}"
    lowest = value if scale.vmin is None else scale.vmin
    drawn = max(value, lowest)  # zero has no logarithm
    panel.text(*place, text, color="#ffffff" if scale(drawn) < _DARK else "#000000", **style)
    return drawn


def _draw_scale(figure: Figure, panels: Sequence[Axes], shown: tuple[Axis, LogNorm]) -> None:
    """Draw the colour bar to the right of all maps."""
    axis, scale = shown
    first = panels[0].get_position()
    bottom = panels[-1].get_position().y0
    left = first.x1 + _BAR_GAP_IN / COLUMN_IN
    bar_place = (left, bottom, _BAR_IN / COLUMN_IN, first.y1 - bottom)
    bar = figure.colorbar(ScalarMappable(scale), cax=figure.add_axes(bar_place))
    label_decades(bar.ax.yaxis)

    above = first.y1 + 2.0 / _POINTS_PER_IN / figure.get_figheight()
    figure.text(0.99, above, axis.title, ha="right", va="bottom", fontsize=TEXT)
