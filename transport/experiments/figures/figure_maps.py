"""Maps of two quantities, one for each scenario: a number as colour and text, and completed runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from transport.experiments.figures.axes_and_units import Axis
from transport.experiments.figures.colour_scale import draw_colour_bar, scale_of
from transport.experiments.statistics import PointStatistics, values_of
from transport.model.arrays import Array
from transport.report.figures.column import Room, column_panels, head
from transport.report.figures.style import POINTS_PER_IN, SMALL, TEXT, label_decades

# Height of a row and of a row with a name, and of a map at least, as its vertical axis has a title; room
# above a map, right of it, and left of and below one with names, inches.
_ROW_IN = 0.27
_NAMED_ROW_IN = 0.2
_LEAST_IN = 1.05
_ABOVE_IN = 0.2
_RIGHT_IN = 0.42
_NAMES_IN = 1.15
_BELOW_NAMES_IN = 0.45
_ABOVE_BAR_PT = 2.0  # of the name of the colours, points
_NAME_RIGHT = 0.99  # end of this name, of the width of the figure
_DECADES = 3.0  # of the scale below its end at most: less is no difference
_FEW_DIGITS = 10.0  # numbers from here on have one decimal
_DARK = 0.55  # share of the scale below which colours are dark: numbers on them are white
_WITHOUT_NUMBER: Any = {
    "facecolor": "#ffffff",
    "hatch": "////",
    "edgecolor": "#c8c8c8",
    "linewidth": 0.0,
}
_ON_HATCH = {"facecolor": "#ffffff", "edgecolor": "none", "pad": 0.6}
_TEXT: Any = {"ha": "center", "va": "center", "fontsize": SMALL, "linespacing": 1.0}


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
    means = [one.mean(shown.label) or 0.0 for one in measured]
    numbers = _Numbers(shown, scale_of([shown.factor * mean for mean in means], _DECADES))
    along = _Side(x, _in_order(values_of(measured, x.label)))
    up = _Side(y, _in_order(values_of(measured, y.label)))

    row_in = _ROW_IN
    room = Room(right_in=_RIGHT_IN, top_in=_ABOVE_IN)
    if up.is_named:
        row_in = _NAMED_ROW_IN
        room = replace(room, left_in=_NAMES_IN, bottom_in=_BELOW_NAMES_IN)
    heights_in = [max(row_in * len(up.values), _LEAST_IN)] * len(scenarios)
    panels = column_panels(figure, heights_in, x_label=x.title, room=room)
    for panel, (scenario, own) in zip(panels, scenarios.items(), strict=True):
        _draw_map(panel, own, (along, up), numbers)
        head(panel, scenario, legend=False)
    _draw_scale(figure, panels, numbers)


@dataclass(frozen=True, slots=True)
class _Numbers:
    """The number that maps show, with the scale of its colours."""

    shown: Axis
    scale: LogNorm


@dataclass(frozen=True, slots=True)
class _Side:
    """Axis of a map with its values, a column or a row each."""

    axis: Axis
    values: Sequence[str | float]

    @property
    def is_named(self) -> bool:
        """Whether the values are names."""
        return isinstance(self.values[0], str)

    def place(self, one: PointStatistics) -> int:
        """Return the column or row of a point."""
        return self.values.index(one.point.labels[self.axis.label])

    def ticks(self) -> list[str]:
        """Return the text of each value."""
        return [
            value if isinstance(value, str) else f"{self.axis.factor * value:g}"
            for value in self.values
        ]


def _draw_scale(figure: Figure, panels: Sequence[Axes], numbers: _Numbers) -> None:
    """Draw the colour bar of all maps, with the name of their number above it."""
    bar = draw_colour_bar(figure, panels, numbers.scale)
    label_decades(bar.ax.yaxis)
    above = panels[0].get_position().y1 + _ABOVE_BAR_PT / POINTS_PER_IN / figure.get_figheight()
    title = numbers.shown.title
    figure.text(_NAME_RIGHT, above, title, ha="right", va="bottom", fontsize=TEXT)


def _in_order(values: Sequence[str | float]) -> list[str | float]:
    """Return the values along an axis: numbers in increasing order, names in theirs."""
    numbers = [value for value in values if not isinstance(value, str)]
    return [*values] if len(numbers) < len(values) else [*sorted(numbers)]


def _draw_map(
    panel: Axes,
    measured: Sequence[PointStatistics],
    sides: tuple[_Side, _Side],
    numbers: _Numbers,
) -> None:
    """Draw the cells of a scenario, and label their columns and rows, which are the sides."""
    along, up = sides
    shape = (len(up.values), len(along.values))
    colours = np.full(shape, np.nan)  # of cells with a number; the others have none
    by_place = {(along.place(one), up.place(one)): one for one in measured}  # the last one counts
    for (column, row), one in by_place.items():
        if _tells_number(one, numbers.shown):
            colours[row, column] = _draw_number(panel, (column, row), one, numbers)
        else:
            _draw_without_number(panel, (column, row), one, numbers.shown)
    _colour(panel, colours, numbers.scale, is_named=up.is_named)

    columns = [text.replace(" ", "\n") for text in along.ticks()]
    panel.set_xticks(range(len(columns)), columns, fontsize=SMALL)
    panel.set_yticks(range(len(up.values)), up.ticks())
    panel.set_ylabel("" if up.is_named else up.axis.title)  # names say by themselves what they are
    panel.tick_params(length=0.0)
    panel.grid(visible=False)


def _colour(panel: Axes, colours: Array, scale: LogNorm, *, is_named: bool) -> None:
    """Colour the cells by their numbers, (rows, columns), nan where there is none; the first name is at the top."""
    panel.patch.set(facecolor="none")
    panel.imshow(colours, norm=scale, aspect="auto", origin="upper" if is_named else "lower")


def _tells_number(one: PointStatistics, shown: Axis) -> bool:
    """Return whether a cell shows the number of a point.

    A cost does as soon as one run completes. Where some runs collide, the distance of the others says little.
    """
    is_cost = shown.label == "cost_mean"
    return one.mean(shown.label) is not None and (is_cost or one.completed == one.runs)


def _draw_without_number(
    panel: Axes, place: tuple[int, int], one: PointStatistics, shown: Axis
) -> None:
    """Hatch a cell, with how many runs complete, or when the first ends if none does."""
    column, row = place
    panel.add_patch(Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, **_WITHOUT_NUMBER))
    text = "-"
    if one.mean(shown.label) is not None:
        text = f"{one.completed} of {one.runs}"
    elif one.diverged_s:
        text = f"ends at\n{one.diverged_s[0]:.1f} s"
    panel.text(*place, text, bbox=_ON_HATCH, **_TEXT)


def _draw_number(
    panel: Axes, place: tuple[int, int], one: PointStatistics, numbers: _Numbers
) -> float:
    """Write the number of a cell, and how many runs complete if not all do; return the number of its colour."""
    value = numbers.shown.factor * (one.mean(numbers.shown.label) or 0.0)
    text = f"{value:.2f}" if value < _FEW_DIGITS else f"{value:.1f}"
    if one.completed < one.runs:
        text += f"\n{one.completed} of {one.runs}"

    lowest = value if numbers.scale.vmin is None else numbers.scale.vmin
    coloured = max(value, lowest)  # zero has no logarithm
    is_dark = numbers.scale(coloured) < _DARK
    panel.text(*place, text, color="#ffffff" if is_dark else "#000000", **_TEXT)
    return coloured
