"""Figures as wide as a column of a paper (8.5 cm): panels over time, each with a title and legend above it."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation

from protocol.scenario.setup import Setup
from transport.report.marks import Mark, caption_height_in, draw_marks
from transport.report.style import COLUMN_IN, shade_phases

# Margins and gap between panels, inches: fixed, as a layout engine takes as long as drawing.
_LEFT_IN, _RIGHT_IN, _TOP_IN, _BOTTOM_IN, _GAP_IN = 0.46, 0.08, 0.32, 0.36, 0.2
_FONT = 7.0
# Most entries of a legend beside a title.
_MOST = 5
_LIMIT = "#B2182B"


def column_panels(
    figure: Figure, count: int, height_in: float, marks: Sequence[Mark] = (), *, top_in: float = _TOP_IN
) -> list[Axes]:
    """Return stacked panels of an empty figure, which gets its size, with room above and for the caption of marks."""
    below_in = _BOTTOM_IN + caption_height_in(marks)
    total_in = top_in + count * height_in + (count - 1) * _GAP_IN + below_in
    figure.set_size_inches(COLUMN_IN, total_in)
    width = 1.0 - (_LEFT_IN + _RIGHT_IN) / COLUMN_IN
    panels: list[Axes] = []
    for row in range(count):
        bottom_in = below_in + (count - 1 - row) * (height_in + _GAP_IN)
        panel = figure.add_axes((_LEFT_IN / COLUMN_IN, bottom_in / total_in, width, height_in / total_in))
        panel.tick_params(labelsize=_FONT, pad=1.5, length=2.0, labelbottom=row == count - 1)
        panel.locator_params(axis="y", nbins=5)
        panels.append(panel)
    panels[-1].set_xlabel("time (s)", fontsize=_FONT, labelpad=1.0)
    return panels


def head(panel: Axes, title: str, *, legend: bool = True) -> None:
    """Write the title above a panel, and at its right the legend of labelled curves, if it fits."""
    up = ScaledTranslation(0.0, 2.0 / 72.0, panel.figure.dpi_scale_trans)
    panel.text(0.0, 1.0, title, transform=panel.transAxes + up, ha="left", va="bottom", fontsize=_FONT)
    handles, labels = panel.get_legend_handles_labels()
    if legend and 1 < len(handles) <= _MOST:
        panel.legend(
            handles,
            labels,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=len(handles),
            fontsize=6.0,
            handlelength=1.0,
            handletextpad=0.3,
            columnspacing=0.7,
            borderaxespad=0.0,
            borderpad=0.1,
        )


def finish(figure: Figure, panels: Sequence[Axes], setup: Setup, until_s: float, marks: Sequence[Mark]) -> None:
    """Shade and name the phases, and draw the marks."""
    shade_phases(setup, list(panels), until_s, above_pt=11.0)
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
