"""Stacked panels in the width of a paper's column, with titles, legends, limits and marks of events: every figure."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

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

# Height of a row of a legend, and its margin, inches; parts of an entry and of the title of a row, in font sizes.
_ROW_IN, _MARGIN_IN = 0.115, 0.08
_HANDLE, _PAD, _BETWEEN = 1.6, 0.4, 0.8
# Most entries of a legend beside a title, and its distances, in font sizes.
_MOST = 5
_CLOSE: Any = {
    "handlelength": 1.0, "handletextpad": 0.3, "columnspacing": 0.7, "borderaxespad": 0.0, "borderpad": 0.1
}  # fmt: skip

_LIMIT, _FAULT, _LINK = "#B2182B", "#B2182B", "#E69F00"
_LINE_IN, _APART_IN = 0.105, 0.06
# Characters in a line of the caption; most marks in it; marks nearer than this share of the axis have one label.
_WRAP, _MOST_MARKS, _NEAR = 72, 12, 0.035

# Labelled handles by the title of their row; an empty title takes no room.
Rows = Mapping[str, Sequence[Line2D]]


class Mark(NamedTuple):
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
    left_in: float = 0.46,
    right_in: float = 0.08,
    top_in: float = 0.32,
    gap_in: float = 0.2,
    bottom_in: float = 0.28,
) -> list[Axes]:
    """Return stacked panels of an empty figure, which gets its size, with room above and for the caption of marks.

    Margins and gaps are fixed, as a layout engine takes as long as drawing. Only the lowest panel has numbers and a
    label below it.
    """
    below_in = bottom_in + _LINE_IN * len(caption_of(marks)) + (_APART_IN if marks else 0.0)
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
        panel.legend(handles, labels, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(handles), **_CLOSE)


def legend_height_in(rows: Rows) -> float:
    """Return the height of a legend, inches."""
    return _ROW_IN * (max(line for line, _, _ in _placed(rows)) + 1) + 0.04


def draw_legend(figure: Figure, rows: Rows, *, top_in: float = 0.02) -> None:
    """Draw the legend at the top of a figure: rows of labelled handles, each behind its title.

    A row that is too wide is continued in the next.
    """
    width_in, height_in = figure.get_size_inches()
    em_in = SMALL / 72.0
    for line, x_in, entry in _placed(rows):
        y, weight = 1.0 - (top_in + (line + 0.5) * _ROW_IN) / height_in, "bold"
        if isinstance(entry, Line2D):  # with its marker in the middle
            entry.set_data([(x_in + share * _HANDLE * em_in) / width_in for share in (0.0, 0.5, 1.0)], [y, y, y])
            entry.set_markevery([1])
            figure.add_artist(entry)
            x_in, weight = x_in + (_HANDLE + _PAD) * em_in, "normal"
        text = str(entry.get_label()) if isinstance(entry, Line2D) else entry
        figure.text(x_in / width_in, y, text, fontsize=SMALL, va="center_baseline", weight=weight)


def _placed(rows: Rows) -> Iterator[tuple[int, float, Line2D | str]]:
    """Yield the titles and handles of a legend with their line and place from the left, inches."""
    em_in, line, left_in = SMALL / 72.0, -1, _MARGIN_IN
    if any(rows):
        left_in += max(text_width_in(title, weight="bold") for title in rows) + em_in
    for title, handles in rows.items():
        line, x_in = line + 1, left_in
        yield line, _MARGIN_IN, title
        for handle in handles:
            entry_in = (_HANDLE + _PAD + _BETWEEN) * em_in + text_width_in(str(handle.get_label()))
            if left_in < x_in > COLUMN_IN - entry_in:
                line, x_in = line + 1, left_in
            yield line, x_in, handle
            x_in += entry_in


def text_width_in(text: str, weight: str = "normal") -> float:
    """Return the width of a small text in print, inches."""
    font = FontProperties(size=SMALL, weight=weight)
    width, _, _ = text_to_path.get_text_width_height_descent(text, font, "$" in text)
    return float(width) / 72.0


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
    return sorted(dict.fromkeys(_marks(setup, log)), key=lambda mark: mark.time_s)[:_MOST_MARKS]


def caption_of(marks: Sequence[Mark]) -> list[str]:
    """Return the lines that explain the numbers of the marks."""
    texts = [f"{number}: {mark.text} ({mark.time_s:g} s)" for number, mark in enumerate(marks, start=1)]
    return textwrap.wrap("; ".join(texts), _WRAP)


def finish(figure: Figure, panels: Sequence[Axes], setup: Setup, until_s: float, marks: Sequence[Mark]) -> None:
    """Shade and name the phases; draw the marks, their numbers into the first panel, and the caption below all."""
    shade_phases(setup, list(panels), until_s)
    labels: list[tuple[float, str]] = []
    for number, mark in enumerate(marks, start=1):
        colour, dashes = (_LINK, ":") if mark.of_links else (_FAULT, "-")
        for panel in panels:
            panel.axvline(mark.time_s, linewidth=0.8, zorder=1.5, color=colour, linestyle=dashes)
        time_s, text = mark.time_s, str(number)
        if labels and time_s - labels[-1][0] < _NEAR * until_s:
            time_s, before = labels.pop()
            text = f"{before.split('-')[0]}-{number}"
        labels.append((time_s, text))
    for time_s, text in labels:
        right_pt, side = (-1.5, "right") if time_s > (1.0 - _NEAR) * until_s else (1.5, "left")
        place: Any = {"xycoords": panels[0].get_xaxis_transform(), "textcoords": "offset points", "va": "top"}
        panels[0].annotate(text, (time_s, 1.0), (right_pt, -1.0), ha=side, fontsize=SMALL, **place)
    if marks:
        figure.text(0.02, 0.04 / figure.get_figheight(), "\n".join(caption_of(marks)), fontsize=SMALL, va="bottom")


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
    for message in (entry.message for entry in log.messages):
        time_s = message.tick * period_s
        match message:
            case FaultNote():
                yield Mark(time_s, f"{message.target} {message.what}", False)
            case LinkChange():
                yield Mark(time_s, words_of(message), True)
            case Target():
                yield Mark(time_s, target_in_words(message), True)
            case Roster() if message.off != off:
                off = message.off
                yield Mark(time_s, message.reason.partition(" at t =")[0], False)
