"""Stacked panels in the width of a paper's column, with titles, legends, limits and marks of events: every figure."""

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.textpath import text_to_path
from matplotlib.transforms import ScaledTranslation

from protocol.scenario.links import change_in_words, words_of
from protocol.scenario.setup import Setup
from protocol.scenario.targets import target_in_words
from protocol.wire.messages import FaultNote, LinkChange, Roster, Target
from transport.log.run_log import RunLog
from transport.report.style import COLUMN_IN, SMALL, TEXT, shade_phases

# Margins and gap between panels, inches: fixed, as a layout engine takes as long as drawing.
LEFT_IN, TOP_IN, GAP_IN = 0.46, 0.32, 0.2
_RIGHT_IN, BOTTOM_IN = 0.08, 0.28
_LIMIT = "#B2182B"

# Height of a row of a legend, inches; parts of an entry and of the title of a row, in font sizes.
_ROW_IN = 0.115
_HANDLE, _PAD, _BETWEEN = 1.6, 0.4, 0.8
# Most entries of a legend beside a title.
_MOST = 5

_FAULT, _LINK = "#B2182B", "#E69F00"
_FONT, _LINE_IN, _APART_IN = 6.0, 0.105, 0.06
# Characters in a line of the caption; most marks in it; marks nearer than this share of the axis have one label.
_WRAP, _MOST_MARKS, _NEAR = 72, 12, 0.035

Rows = Mapping[str, Sequence[Line2D]]


@dataclass(frozen=True, slots=True)
class Mark:
    """An event at a time of the run, s; of the links, or else of a process or UAV."""

    time_s: float
    text: str
    of_links: bool


def column_panels(
    figure: Figure,
    heights_in: Sequence[float],
    marks: Sequence[Mark] = (),
    *,
    x_label: str = "time (s)",
    left_in: float = LEFT_IN,
    right_in: float = _RIGHT_IN,
    top_in: float = TOP_IN,
    gap_in: float = GAP_IN,
    bottom_in: float = BOTTOM_IN,
) -> list[Axes]:
    """Return stacked panels of an empty figure, which gets its size, with room above and for the caption of marks.

    Only the lowest panel has numbers and a label below it.
    """
    below_in = bottom_in + caption_height_in(marks)
    total_in = top_in + sum(heights_in) + (len(heights_in) - 1) * gap_in + below_in
    figure.set_layout_engine("none")
    figure.set_size_inches(COLUMN_IN, total_in)
    width = 1.0 - (left_in + right_in) / COLUMN_IN
    panels: list[Axes] = []
    upper_in = total_in - top_in
    for row, height_in in enumerate(heights_in):
        panel = figure.add_axes((left_in / COLUMN_IN, (upper_in - height_in) / total_in, width, height_in / total_in))
        panel.tick_params(labelbottom=row == len(heights_in) - 1)
        panel.locator_params(axis="y", nbins=5)
        panels.append(panel)
        upper_in -= height_in + gap_in
    panels[-1].set_xlabel(x_label)
    return panels


def head(panel: Axes, title: str, *, legend: bool = True) -> None:
    """Write the title above a panel, and at its right the legend of labelled curves, if it fits."""
    up = ScaledTranslation(0.0, 2.0 / 72.0, panel.figure.dpi_scale_trans)
    panel.text(0.0, 1.0, title, transform=panel.transAxes + up, ha="left", va="bottom", fontsize=TEXT)
    handles, labels = panel.get_legend_handles_labels()
    if legend and 1 < len(handles) <= _MOST:
        panel.legend(
            handles,
            labels,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=len(handles),
            handlelength=1.0,
            handletextpad=0.3,
            columnspacing=0.7,
            borderaxespad=0.0,
            borderpad=0.1,
        )


def legend_height_in(rows: Rows) -> float:
    """Return the height of a legend, inches."""
    return _ROW_IN * len(_wrapped(rows)) + 0.04


def draw_legend(figure: Figure, rows: Rows, *, top_in: float = 0.02) -> None:
    """Draw the legend at the top of a figure: rows of labelled handles, each behind its title, in aligned columns.

    A row that is too wide is continued in the next; an empty title takes no room.
    """
    width_in, height_in = figure.get_size_inches()
    titled = any(rows)
    lines = _wrapped(rows)
    widths = _widths([handles for _, handles in lines])
    x = [0.08 + (_title_in(rows) if titled else 0.0)]
    for entry_in in widths:
        x.append(x[-1] + entry_in)
    for number, (title, handles) in enumerate(lines):
        y_in = height_in - top_in - (number + 0.5) * _ROW_IN
        figure.text(0.08 / width_in, y_in / height_in, title, fontsize=SMALL, va="center_baseline", weight="bold")
        for handle, left_in in zip(handles, x, strict=False):
            _draw_entry(figure, handle, left_in, y_in)


def _draw_entry(figure: Figure, handle: Line2D, left_in: float, y_in: float) -> None:
    """Draw a handle, with its marker in the middle, and its label from a place in inches on."""
    width_in, height_in = figure.get_size_inches()
    em_in, y = SMALL / 72.0, y_in / height_in
    handle.set_data([(left_in + share * _HANDLE * em_in) / width_in for share in (0.0, 0.5, 1.0)], [y, y, y])
    handle.set_markevery([1])
    figure.add_artist(handle)
    label_in = left_in + (_HANDLE + _PAD) * em_in
    figure.text(label_in / width_in, y, str(handle.get_label()), fontsize=SMALL, va="center_baseline")


def _wrapped(rows: Rows) -> list[tuple[str, list[Line2D]]]:
    """Return the lines of a legend: title, empty in continued lines, and handles, as many as fit the width."""
    room_in = COLUMN_IN - 0.1 - _title_in(rows)
    most = max(len(handles) for handles in rows.values())
    lines: list[tuple[str, list[Line2D]]] = []
    for count in range(1, most + 1):  # lines of a row
        columns = math.ceil(most / count)
        lines = [
            (title if first == 0 else "", list(handles[first : first + columns]))
            for title, handles in rows.items()
            for first in range(0, max(1, len(handles)), columns)
        ]
        if sum(_widths([handles for _, handles in lines])) <= room_in:
            break
    return lines


def _widths(lines: Sequence[Sequence[Line2D]]) -> list[float]:
    """Return the widths of the columns of a legend, inches."""
    em_in = SMALL / 72.0
    count = max(len(handles) for handles in lines)
    columns = [[handles[i] for handles in lines if i < len(handles)] for i in range(count)]
    around_in = (_HANDLE + _PAD + _BETWEEN) * em_in
    return [around_in + max(text_width_in(str(handle.get_label())) for handle in own) for own in columns]


def _title_in(rows: Rows) -> float:
    """Return the width of the titles of a legend, inches."""
    if not any(rows):
        return 0.0
    return max(text_width_in(title, weight="bold") for title in rows) + SMALL / 72.0


def text_width_in(text: str, size: float = SMALL, weight: str = "normal") -> float:
    """Return the width of a text in print, inches."""
    font = FontProperties(size=size, weight=weight)
    width, _, _ = text_to_path.get_text_width_height_descent(text, font, "$" in text)
    return float(width) / 72.0


def finish(figure: Figure, panels: Sequence[Axes], setup: Setup, until_s: float, marks: Sequence[Mark]) -> None:
    """Shade and name the phases, and draw the marks."""
    shade_phases(setup, list(panels), until_s)
    draw_marks(figure, panels, marks)


def limits(panel: Axes, *values: float) -> None:
    """Draw limits as dashed lines where they are near the curves; elsewhere the title alone names them."""
    low, high = panel.get_ylim()
    span = high - low
    for value in values:
        if low - 0.5 * span <= value <= high + 0.5 * span:
            panel.axhline(value, color=_LIMIT, linestyle="--", linewidth=0.8)
            low, high = min(low, value - 0.05 * span), max(high, value + 0.05 * span)
    panel.set_ylim(low, high)


def marks_of(setup: Setup, log: RunLog) -> list[Mark]:
    """Return the marks of a run in the order of time; changes that come together are one mark."""
    found = sorted(dict.fromkeys(_marks(setup, log)), key=lambda mark: mark.time_s)
    return found[:_MOST_MARKS]


def caption_of(marks: Sequence[Mark]) -> list[str]:
    """Return the lines that explain the numbers of the marks."""
    texts = [f"{number}: {mark.text} ({mark.time_s:g} s)" for number, mark in enumerate(marks, start=1)]
    return textwrap.wrap("; ".join(texts), _WRAP) if texts else []


def caption_height_in(marks: Sequence[Mark]) -> float:
    """Return the height of the caption with its distance from the figure, inches."""
    return _LINE_IN * len(caption_of(marks)) + (_APART_IN if marks else 0.0)


def draw_marks(figure: Figure, panels: Sequence[Axes], marks: Sequence[Mark]) -> None:
    """Draw the lines into stacked panels over time, their numbers into the first, and the caption below the figure."""
    until_s = panels[0].get_xlim()[1]
    last: list[tuple[float, str]] = []
    for number, mark in enumerate(marks, start=1):
        colour = _LINK if mark.of_links else _FAULT
        style: Any = {"color": colour, "linewidth": 0.8, "linestyle": ":" if mark.of_links else "-", "zorder": 1.5}
        for panel in panels:
            panel.axvline(mark.time_s, **style)
        if last and mark.time_s - last[-1][0] < _NEAR * until_s:
            last[-1] = (last[-1][0], f"{last[-1][1].split('-')[0]}-{number}")
        else:
            last.append((mark.time_s, str(number)))
    for time_s, label in last:
        at_edge = time_s > (1.0 - _NEAR) * until_s
        panels[0].annotate(
            label,
            (time_s, 1.0),
            (-1.5 if at_edge else 1.5, -1.0),
            xycoords=panels[0].get_xaxis_transform(),
            textcoords="offset points",
            ha="right" if at_edge else "left",
            va="top",
            fontsize=_FONT,
        )
    if marks:
        figure.text(0.02, 0.04 / figure.get_figheight(), "\n".join(caption_of(marks)), fontsize=_FONT, va="bottom")


def _marks(setup: Setup, log: RunLog) -> Iterator[Mark]:
    period_s, links = setup.settings.sampling_period_s, setup.scenario.links
    end_s = (setup.ticks if log.messages else 0) * period_s
    for change in links.change:
        yield Mark(change.at_s, change_in_words(change.from_ or "", change.to or "", change.settings()), True)
    for partition in links.partition:
        names = ", ".join(partition.between)
        yield Mark(partition.start_s, f"{names} cut off", True)
        if partition.end_s < end_s:
            yield Mark(partition.end_s, f"{names} connected again", True)
    off: tuple[int, ...] = ()
    numbers, targets = set[int](), set[int]()
    for message in (entry.message for entry in log.messages):
        if isinstance(message, FaultNote):
            yield Mark(message.tick * period_s, f"{message.target} {message.what}", False)
        elif isinstance(message, LinkChange) and message.number not in numbers:
            numbers.add(message.number)  # repeated for an agent that joins late
            yield Mark(message.tick * period_s, words_of(message), True)
        elif isinstance(message, Target) and message.number not in targets:
            targets.add(message.number)
            yield Mark(message.tick * period_s, target_in_words(message), True)
        elif isinstance(message, Roster) and message.off != off:
            off = message.off
            yield Mark(message.tick * period_s, message.reason.partition(" at t =")[0], False)
