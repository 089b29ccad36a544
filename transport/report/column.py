"""Stacked panels in the width of a paper's column, with titles, legends, limits and marks of events: every figure."""

import textwrap
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.textpath import text_to_path
from matplotlib.transforms import ScaledTranslation

from transport.log.run_log import RunLog
from transport.protocol.scenario.link_changes import change_in_words
from transport.protocol.scenario.setup import Setup
from transport.report.style import COLUMN_IN, SMALL, TEXT, shade_phases
from transport.scene.history import RunHistory

# Height of a row of a legend, and room for the line of an entry and the gap behind it, inches.
_ROW_IN, _HANDLE_IN = 0.115, 0.26
CLOSE: Any = {
    "handletextpad": 0.4, "columnspacing": 0.8, "labelspacing": 0.35, "borderaxespad": 0.0, "borderpad": 0.2
}  # fmt: skip
# Most entries of a legend beside a title; longer ones are above all panels.
MOST_BESIDE = 5

_LIMIT, _FAULT, _LINK = "#B2182B", "#B2182B", "#E69F00"
_LINE_IN, _APART_IN = 0.105, 0.06
# Characters in a line of the caption; most marks in it; the first of marks nearer than this share
# has a number.
_WRAP, _MOST_MARKS, _NEAR = 72, 12, 0.035


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
    legend: Sequence[Line2D] = (),
    x_label: str = "time (s)",
    left_in: float = 0.46,
    right_in: float = 0.08,
    top_in: float = 0.32,
    gap_in: float = 0.2,
    bottom_in: float = 0.28,
) -> list[Axes]:
    """Return stacked panels of an empty figure, which gets its size.

    Below a legend, above the caption of marks.

    Margins and gaps are fixed, as a layout engine takes as long as drawing. Only the lowest panel
    has numbers and a label below it.
    """
    top_in += legend_height_in(legend)
    below_in = bottom_in + _LINE_IN * len(caption_of(marks)) + (_APART_IN if marks else 0.0)
    total_in = top_in + sum(heights_in) + (len(heights_in) - 1) * gap_in + below_in
    figure.set_layout_engine("none")
    figure.set_size_inches(COLUMN_IN, total_in)
    draw_legend(figure, legend)
    width = 1.0 - (left_in + right_in) / COLUMN_IN
    panels: list[Axes] = []
    upper_in = total_in - top_in
    for height_in in heights_in:
        panel = figure.add_axes(
            (left_in / COLUMN_IN, (upper_in - height_in) / total_in, width, height_in / total_in)
        )
        panel.tick_params(labelbottom=False)
        panel.locator_params(axis="y", nbins=5)
        panels.append(panel)
        upper_in -= height_in + gap_in
    panels[-1].tick_params(labelbottom=True)
    panels[-1].set_xlabel(x_label)
    return panels


def head(panel: Axes, title: str, *, legend: bool = True) -> None:
    """Write the title above a panel, and at its right the legend of labelled curves, if it fits."""
    up = ScaledTranslation(0.0, 2.0 / 72.0, panel.figure.dpi_scale_trans)
    panel.text(
        0.0, 1.0, title, transform=panel.transAxes + up, ha="left", va="bottom", fontsize=TEXT
    )
    handles, labels = panel.get_legend_handles_labels()
    if legend and 1 < len(handles) <= MOST_BESIDE:
        where: Any = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": len(handles)}
        panel.legend(handles, labels, handlelength=1.0, **where, **CLOSE)


def legend_height_in(handles: Sequence[Line2D]) -> float:
    """Return the height of a legend, inches."""
    return _ROW_IN * -(-len(handles) // _columns(handles)) + 0.06 if handles else 0.0


def draw_legend(figure: Figure, handles: Sequence[Line2D]) -> None:
    """Draw the legend of labelled handles at the top of a figure, in as many columns as fit."""
    if handles:
        place = (0.015, 1.0 - 0.02 / figure.get_figheight())
        figure.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=place,
            ncols=_columns(handles),
            **CLOSE,
        )


def _columns(handles: Sequence[Line2D]) -> int:
    widest_in = max(text_width_in(str(handle.get_label())) for handle in handles)
    return max(1, int((COLUMN_IN - 0.05) / (widest_in + _HANDLE_IN)))


def text_width_in(text: str) -> float:
    """Return the width of a small text in print, inches."""
    font = FontProperties(size=SMALL)
    width, _, _ = text_to_path.get_text_width_height_descent(text, font, "$" in text)
    return float(width) / 72.0


def limits(panel: Axes, *values: float) -> None:
    """Draw limits as dashed lines where they are near the curves.

    Elsewhere the title alone names them.
    """
    low, high = panel.get_ylim()
    span = high - low
    for value in values:
        if low - 0.5 * span <= value <= high + 0.5 * span:
            widen(panel, value - 0.05 * span, value + 0.05 * span)
            panel.axhline(value, color=_LIMIT, linestyle="--", linewidth=0.8)


def widen(panel: Axes, low: float, high: float) -> None:
    """Let an axis show at least a range."""
    panel.set_ylim(min(panel.get_ylim()[0], low), max(panel.get_ylim()[1], high))


def marks_of(setup: Setup, log: RunLog) -> list[Mark]:
    """Return the marks of a run in the order of time; changes that come together are one mark."""
    return sorted(dict.fromkeys(_marks(setup, log)), key=lambda mark: mark.time_s)[:_MOST_MARKS]


def caption_of(marks: Sequence[Mark]) -> list[str]:
    """Return the lines that explain the numbers of the marks."""
    texts = [
        f"{number}: {mark.text} ({mark.time_s:g} s)" for number, mark in enumerate(marks, start=1)
    ]
    return textwrap.wrap("; ".join(texts), _WRAP)


def finish(
    figure: Figure, panels: Sequence[Axes], setup: Setup, until_s: float, marks: Sequence[Mark]
) -> None:
    """Shade and name the phases.

    Draw the marks, their numbers into the first panel, and the caption below all.
    """
    shade_phases(setup, list(panels), until_s)
    labelled_s = -np.inf
    for number, mark in enumerate(marks, start=1):
        colour, dashes = (_LINK, ":") if mark.of_links else (_FAULT, "-")
        for panel in panels:
            panel.axvline(mark.time_s, linewidth=0.8, zorder=1.5, color=colour, linestyle=dashes)
        if mark.time_s - labelled_s > _NEAR * until_s:
            labelled_s = mark.time_s
            side, right_pt = (
                ("right", -1.5) if mark.time_s > (1.0 - _NEAR) * until_s else ("left", 1.5)
            )
            place: Any = {
                "xycoords": panels[0].get_xaxis_transform(),
                "textcoords": "offset points",
                "va": "top",
            }
            panels[0].annotate(
                f"{number}", (mark.time_s, 1.0), (right_pt, -1.0), ha=side, fontsize=SMALL, **place
            )
    if marks:
        figure.text(
            0.02,
            0.04 / figure.get_figheight(),
            "\n".join(caption_of(marks)),
            fontsize=SMALL,
            va="bottom",
        )


def _marks(setup: Setup, log: RunLog) -> Iterator[Mark]:
    period_s, links = setup.settings.sampling_period_s, setup.scenario.links
    end_s = (setup.ticks if log.messages else 0) * period_s
    for change in links.change:
        yield Mark(
            change.at_s,
            change_in_words(change.from_ or "", change.to or "", change.settings()),
            True,
        )
    for partition in links.partition:
        names = ", ".join(partition.between)
        yield Mark(partition.start_s, f"{names} cut off", True)
        if partition.end_s < end_s:
            yield Mark(partition.end_s, f"{names} connected again", True)
    history = RunHistory(setup)
    history.add(entry.message for entry in log.messages)
    for tick, text in history.events:
        yield Mark(
            tick * period_s, text.partition(" at t =")[0], text.startswith(("links", "target"))
        )
