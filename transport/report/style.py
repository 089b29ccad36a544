"""Style of all figures: size, fonts, colours for colour-blind readers, and the phases of the maneuver."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullLocator
from matplotlib.transforms import ScaledTranslation

from protocol.scenario.setup import Setup

# Width of figures with a legend at their side, and of a paper's column (8.5 cm), inches.
WIDTH_IN, COLUMN_IN = 5.2, 3.35
DPI = 150
# Resolution of a figure as wide as a column.
COLUMN_DPI = 240

RC: Any = {  # the type depends on the version of matplotlib
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "axes.titlesize": 9.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#d9d9d9",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.2,
    "figure.dpi": DPI,
    "savefig.dpi": DPI,
    "svg.hashsalt": "transport",  # otherwise names inside an SVG are random
}

# Colours of components (x, y, z; roll, pitch, yaw), different from those of UAVs.
COMPONENTS = ("#000000", "#E69F00", "#56B4E9")
PAYLOAD = "#000000"
REFERENCE = "#8c8c8c"
_BAND = "#f1f1f1"

# Colour (Okabe and Ito 2008), marker and line style of each curve.
CURVES = (
    ("#0072B2", "o", "-"),
    ("#D55E00", "s", "--"),
    ("#009E73", "^", "-."),
    ("#CC79A7", "D", ":"),
    ("#000000", "v", "-"),
)

_THINNEST = 1.0
# Smallest share of the time axis at which a phase is named.
_NARROW = 0.08


def line_width(i: int, count: int, widest: float) -> float:
    """Return the width of curve i in points: decreasing, so that curves that coincide stay visible."""
    return _THINNEST if count == 1 else widest - (widest - _THINNEST) * i / (count - 1)


def shade_phases(
    setup: Setup, panels: list[Axes], until_s: float, *, named: bool = True, above_pt: float = 2.0
) -> None:
    """Shade every other phase of the maneuver in stacked panels and name them above the first.

    Args:
        setup: The run.
        panels: Axes over time in s, from top to bottom.
        until_s: End of the time axis, s.
        named: Whether to name them.
        above_pt: Distance of the names from the panel, points.
    """
    begin = 0.0
    up = ScaledTranslation(0.0, above_pt / 72.0, panels[0].figure.dpi_scale_trans)
    # A letter is about 0.6 of its font size wide; neighbouring names must not touch.
    points_per_s = 72.0 * panels[0].get_window_extent().width / panels[0].figure.dpi / until_s
    wide = [phase for phase in setup.maneuver.phases if phase.duration_s > _NARROW * until_s]
    fitting = (points_per_s * phase.duration_s / (0.62 * len(phase.name)) for phase in wide)
    size = min([8.0, *fitting])
    for number, phase in enumerate(setup.maneuver.phases):
        end = min(begin + phase.duration_s, until_s)
        if end <= begin:
            break
        if number % 2:
            for axes in panels:
                axes.axvspan(begin, end, color=_BAND, linewidth=0, zorder=0)
        if named and end - begin > _NARROW * until_s:
            panels[0].text(
                (begin + end) / 2.0,
                1.0,
                phase.name,
                transform=panels[0].get_xaxis_transform() + up,
                ha="center",
                va="bottom",
                color="#555555",
                fontsize=size,
            )
        begin += phase.duration_s
    for axes in panels:
        axes.set_xlim(0.0, until_s)


def label_decades(axis: Axis) -> None:
    """Label a logarithmic axis of few decades with plain numbers, also within a decade."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_locator(NullLocator())


def scale_cost(axes: Axes, top: float, decades: int) -> None:
    """Set a logarithmic axis that shows so many decades of costs up to `top`; a run without cost keeps its axis."""
    if 0.0 < top < np.inf:
        axes.set_yscale("log")
        axes.set_ylim(top * 10.0**-decades, top * 2.0)


def save(figure: Figure, path: Path, *, cropped: bool = False) -> Path:
    """Write a figure as PNG, SVG or PDF, without program and date, so that equal runs give equal files."""
    unnamed: dict[str, dict[str, None]] = {
        ".svg": {"Date": None, "Creator": None},
        ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
        ".png": {"Software": None},
    }
    dpi = COLUMN_DPI if figure.get_figwidth() <= COLUMN_IN else "figure"
    figure.savefig(
        path, metadata=unnamed[path.suffix], bbox_inches="tight" if cropped else None, pad_inches=0.05, dpi=dpi
    )
    return path


def save_both(figure: Figure, path: Path, *, cropped: bool = False, pdf: bool = False) -> Path:
    """Write a figure as PNG and as SVG, with `pdf` as PDF too, laid out once; return the PNG file."""
    if figure.get_layout_engine() is not None:
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # otherwise each file would be laid out anew, in as much time as it is drawn
    if pdf:
        save(figure, path.with_suffix(".pdf"), cropped=cropped)
    save(figure, path.with_suffix(".svg"), cropped=cropped)
    return save(figure, path, cropped=cropped)
