"""Stacked panels in the width of a paper's column, with titles, legends, limits and marks."""

import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.textpath import text_to_path
from matplotlib.transforms import ScaledTranslation

from transport.log.run_log import RunLog
from transport.protocol.scenario.links.link_changes import scripted_changes
from transport.protocol.scenario.sections.clock_section import first_tick
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import PlantState
from transport.report.figures.style import COLUMN_IN, POINTS_PER_IN, SMALL, TEXT, shade_phases
from transport.scene.history import RunHistory, merged

# Height of a row of a legend, room for the line of an entry and the gap behind it, and rim, inches.
_ROW_IN = 0.115
_HANDLE_IN = 0.26
_RIM_IN = 0.06
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

_LIMIT = "#B2182B"
_FAULT = "#B2182B"
_LINK = "#E69F00"
# Limits within this share of the shown range are drawn, and this share of it is shown beyond them.
_DRAWN = 0.5
_BEYOND = 0.05

# Height of a line of the caption, and its distance from the panels, inches.
_LINE_IN = 0.105
_APART_IN = 0.06
_WRAP = 72  # characters in a line of the caption
_MOST_MARKS = 12  # that are drawn; the caption counts further ones
_OF_LINKS = re.compile(r"(\d+ |all )?links\b|target\b")  # beginning of an event's text
_NEAR = 0.035  # of marks nearer than this share of the run only the first has a number


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """An event at a time of the run, s; of the links, or else of a process or UAV."""

    time_s: float
    text: str
    of_links: bool


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
    below_in = room.bottom_in + _LINE_IN * len(caption_of(marks)) + (_APART_IN if marks else 0.0)
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
    top = 1.0 - 0.02 / figure.get_figheight()
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(0.015, top),
        ncols=_columns(handles),
        **CLOSE,
    )


def _columns(handles: Sequence[Line2D]) -> int:
    """Return the number of columns of a legend that fit the width."""
    widest_in = max(text_width_in(str(handle.get_label())) for handle in handles)
    return max(1, int((COLUMN_IN - 0.05) / (widest_in + _HANDLE_IN)))


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


def caption_of(marks: Sequence[Mark]) -> list[str]:
    """Return the lines that explain the numbers of the marks, and how many are left out."""
    texts = [
        f"{number}: {mark.text} ({mark.time_s:g} s)"
        for number, mark in enumerate(marks[:_MOST_MARKS], start=1)
    ]
    left_out = len(marks) - _MOST_MARKS
    if left_out > 0:
        texts.append(f"{left_out} more not marked")
    return textwrap.wrap("; ".join(texts), _WRAP)


def finish(
    figure: Figure, panels: Sequence[Axes], setup: Setup, until_s: float, marks: Sequence[Mark]
) -> None:
    """Shade and name the phases, and draw the first marks.

    Their numbers are in the first panel, and the caption below all.
    """
    shade_phases(setup, list(panels), until_s)
    labelled_s = -np.inf
    for number, mark in enumerate(marks[:_MOST_MARKS], start=1):
        _draw_mark(panels, mark)
        if mark.time_s - labelled_s > _NEAR * until_s:
            labelled_s = mark.time_s
            _write_number(panels[0], number, mark.time_s, until_s)

    if marks:
        bottom = 0.04 / figure.get_figheight()
        caption = "\n".join(caption_of(marks))
        figure.text(0.02, bottom, caption, fontsize=SMALL, va="bottom")


def _draw_mark(panels: Sequence[Axes], mark: Mark) -> None:
    """Draw a mark as a line through all panels."""
    colour = _LINK if mark.of_links else _FAULT
    dashes = ":" if mark.of_links else "-"
    for panel in panels:
        panel.axvline(mark.time_s, linewidth=0.8, zorder=1.5, color=colour, linestyle=dashes)


def _write_number(panel: Axes, number: int, time_s: float, until_s: float) -> None:
    """Write the number of a mark at its right, or at its left near the end."""
    is_near_end = time_s > (1.0 - _NEAR) * until_s
    side = "right" if is_near_end else "left"
    right_pt = -1.5 if is_near_end else 1.5
    place: Any = {
        "xycoords": panel.get_xaxis_transform(),
        "textcoords": "offset points",
        "va": "top",
    }
    panel.annotate(f"{number}", (time_s, 1.0), (right_pt, -1.0), ha=side, fontsize=SMALL, **place)


def marks_of(setup: Setup, log: RunLog) -> list[Mark]:
    """Return the marks of a run in the order of time; changes that come together are one mark."""
    different = dict.fromkeys(_marks(setup, log))
    return sorted(different, key=lambda mark: mark.time_s)


def _marks(setup: Setup, log: RunLog) -> Iterator[Mark]:
    """Yield the changes of the links and the events of a run until the last tick of its log."""
    period_s = setup.settings.sampling_period_s
    last = max((entry.message.tick for entry in log.messages), default=-1)

    for time_s, text in scripted_changes(setup.scenario.links):
        if first_tick(time_s, period_s) <= last:
            yield Mark(time_s=time_s, text=text, of_links=True)

    contact = setup.contacts().over(log.of(PlantState))
    if contact is not None:
        yield Mark(time_s=round(contact.at_s, 3), text=contact.text, of_links=False)

    history = RunHistory(setup)
    history.add(entry.message for entry in log.messages)
    for tick, text in merged(history.events):
        is_link = _OF_LINKS.match(text) is not None
        yield Mark(time_s=tick * period_s, text=text.partition(" at t =")[0], of_links=is_link)
