"""Stacked panels in the width of a paper's column, with titles, legends and limits."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.textpath import text_to_path
from matplotlib.transforms import ScaledTranslation

from transport.report.figures.event_marks import Mark, caption_height_in
from transport.report.figures.style import COLUMN_IN, POINTS_PER_IN, SMALL, TEXT

# Legend: height of a row, room for the line of an entry and the gap behind it, and rim, inches.
_ROW_IN = 0.115
_HANDLE_IN = 0.26
_RIM_IN = 0.06
_ENDS_IN = 0.05  # left of a legend and right of it together
_LEGEND_LEFT, _LEGEND_BELOW_IN = (
    0.015,
    0.02,
)  # its corner: share of the width, and below the upper edge
CLOSE: Any = {
    "handletextpad": 0.4,
    "columnspacing": 0.8,
    "labelspacing": 0.35,
    "borderaxespad": 0.0,
    "borderpad": 0.2,
}
# Most entries of a legend beside a title; longer ones are above all panels.
MOST_BESIDE = 5
_STRIP = 0.84  # height of one of several strips in place of a panel, in parts of its room
# Numbers of a strip: distance from its top and from each other at least, in parts of its axis.
_BELOW_TOP, _TICKS_APART = 0.2, 0.4
_ROUNDING = 1e-9
_TITLE_PT = 2.0  # distance of a title from its panel, points
_NAME_PT = 12.0  # of the name of a column of panels, above the title
NAME_IN = 0.14  # height of such a name
_BESIDE_IN = 0.1  # gap between panels beside each other

_LIMIT = "#B2182B"
# Limits within this share of the shown range are drawn, and this share of it is shown beyond them.
_DRAWN = 0.5
_BEYOND = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """Margins about stacked panels, and the gap between two of them, inches."""

    left_in: float = 0.46
    right_in: float = 0.08
    top_in: float = 0.32
    gap_in: float = 0.2
    bottom_in: float = 0.28


_ROOM = Room()


def column_panels(
    figure: Figure,
    heights_in: Sequence[float],
    marks: Sequence[Mark] = (),
    *,
    legend: Sequence[Line2D] = (),
    x_label: str = "time (s)",
    room: Room = _ROOM,
) -> list[Axes]:
    """Return stacked panels of an empty figure, which gets its size.

    They are below a legend and above the caption of marks. Margins and gaps are fixed, as a layout
    engine takes as long as drawing. Only the lowest panel has numbers and a label below it.
    """
    top_in = room.top_in + legend_height_in(legend)
    below_in = room.bottom_in + caption_height_in(marks)
    gaps_in = (len(heights_in) - 1) * room.gap_in
    total_in = top_in + sum(heights_in) + gaps_in + below_in
    figure.set_layout_engine("none")
    figure.set_size_inches(COLUMN_IN, total_in)
    draw_legend(figure, legend)

    left = room.left_in / COLUMN_IN
    width = 1.0 - (room.left_in + room.right_in) / COLUMN_IN
    upper_in = total_in - top_in
    panels: list[Axes] = []
    for height_in in heights_in:
        lower_in = upper_in - height_in
        panel = figure.add_axes((left, lower_in / total_in, width, height_in / total_in))
        panel.tick_params(labelbottom=False)
        panel.locator_params(axis="y", nbins=5)
        panels.append(panel)
        upper_in -= height_in + room.gap_in

    panels[-1].tick_params(labelbottom=True)
    panels[-1].set_xlabel(x_label)
    return panels


def strips(panel: Axes, count: int) -> list[Axes]:
    """Replace a panel by so many of the same width below each other, the last one with its axis of time."""
    if count == 1:
        return [panel]
    place = panel.get_position()
    height = place.height / count
    made = []
    for number in range(count):
        below = place.y1 - (number + 1) * height
        strip = panel.figure.add_axes((place.x0, below, place.width, _STRIP * height))
        strip.tick_params(labelbottom=False)
        made.append(strip)
    made[-1].tick_params(labelbottom=panel.xaxis.get_tick_params()["labelbottom"])
    made[-1].set_xlabel(panel.get_xlabel())
    panel.remove()
    return made


def side_by_side(panel: Axes, count: int) -> list[Axes]:
    """Replace a panel by so many beside each other, with the same vertical axis."""
    if count == 1:
        return [panel]
    place = panel.get_position()
    gap = _BESIDE_IN / COLUMN_IN
    width = (place.width - gap * (count - 1)) / count
    made: list[Axes] = []
    for number in range(count):
        left = place.x0 + number * (width + gap)
        first = made[0] if made else None
        one = panel.figure.add_axes((left, place.y0, width, place.height), sharey=first)
        one.tick_params(
            labelbottom=panel.xaxis.get_tick_params()["labelbottom"], labelleft=number == 0
        )
        made.append(one)
    panel.remove()
    return made


def name_above(panel: Axes, name: str) -> None:
    """Write the name of a column of panels above its first one, over the title."""
    up = ScaledTranslation(0.0, _NAME_PT / POINTS_PER_IN, panel.figure.dpi_scale_trans)
    style: Any = {"ha": "center", "va": "bottom", "fontsize": TEXT, "weight": "bold"}
    panel.text(0.5, 1.0, name, transform=panel.transAxes + up, **style)


def label_ends(panel: Axes) -> None:
    """Label two round values of a low panel, apart from each other and from the panel above."""
    low, high = panel.get_ylim()
    span = high - low
    step = 10.0 ** np.ceil(np.log10(span))
    for part in (1.0, 0.5, 0.2, 0.1, 0.05, 0.02):
        first = np.ceil(low / (part * step) - _ROUNDING) * part * step + 0.0  # 0 in place of -0
        last = np.floor((high - _BELOW_TOP * span) / (part * step)) * part * step
        if last - first >= _TICKS_APART * span:
            panel.set_yticks([first, last], [f"{first:g}", f"{last:g}"])
            return


def head(panel: Axes, title: str, *, legend: bool = True) -> None:
    """Write the title above a panel, and at its right the legend of labelled curves, if it fits."""
    up = ScaledTranslation(0.0, _TITLE_PT / POINTS_PER_IN, panel.figure.dpi_scale_trans)
    above = panel.transAxes + up
    panel.text(0.0, 1.0, title, transform=above, ha="left", va="bottom", fontsize=TEXT)

    handles, labels = panel.get_legend_handles_labels()
    if legend and 1 < len(handles) <= MOST_BESIDE:
        place: Any = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": len(handles)}
        panel.legend(handles, labels, handlelength=1.0, **place, **CLOSE)


def legend_height_in(handles: Sequence[Line2D]) -> float:
    """Return the height of a legend, inches."""
    if not handles:
        return 0.0
    rows = -(-len(handles) // _columns(handles))
    return _ROW_IN * rows + _RIM_IN


def draw_legend(figure: Figure, handles: Sequence[Line2D]) -> None:
    """Draw the legend of labelled handles at the top of a figure, in as many columns as fit."""
    if not handles:
        return
    top = 1.0 - _LEGEND_BELOW_IN / figure.get_figheight()
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(_LEGEND_LEFT, top),
        ncols=_columns(handles),
        **CLOSE,
    )


def in_rows(groups: Sequence[Sequence[Line2D]]) -> list[Line2D]:
    """Return the handles of a legend in which each group begins a row and continues in the next ones.

    A legend is filled by columns: handles without a mark fill the rows.
    """
    columns = _columns([handle for group in groups for handle in group])
    rows = [
        [*group[first : first + columns]]
        for group in groups
        for first in range(0, len(group), columns)
    ]
    for row in rows:
        row += [Line2D([], [], linestyle="none", label="") for _ in range(columns - len(row))]
    return [handle for column in zip(*rows, strict=True) for handle in column]


def _columns(handles: Sequence[Line2D]) -> int:
    """Return the number of columns of a legend that fit the width."""
    widest_in = max(text_width_in(str(handle.get_label())) for handle in handles)
    return max(1, int((COLUMN_IN - _ENDS_IN) / (widest_in + _HANDLE_IN)))


def text_width_in(text: str) -> float:
    """Return the width of a small text in print, inches."""
    font = FontProperties(size=SMALL)
    width_pt, _, _ = text_to_path.get_text_width_height_descent(text, font, "$" in text)
    return float(width_pt) / POINTS_PER_IN


def limits(panel: Axes, *values: float) -> None:
    """Draw limits as dashed lines where they are near the curves.

    Elsewhere the title alone names them.
    """
    low, high = panel.get_ylim()
    span = high - low
    for value in values:
        if low - _DRAWN * span <= value <= high + _DRAWN * span:
            widen(panel, value - _BEYOND * span, value + _BEYOND * span)
            panel.axhline(value, color=_LIMIT, linestyle="--", linewidth=0.8)


def widen(panel: Axes, low: float, high: float) -> None:
    """Let an axis show at least a range."""
    shown_low, shown_high = panel.get_ylim()
    panel.set_ylim(min(shown_low, low), max(shown_high, high))
