"""Style of all figures: size, fonts, colours, axes of costs, and the phases of the maneuver."""

import itertools
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_params_from_file
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullLocator
from matplotlib.transforms import ScaledTranslation

from transport.protocol.scenario.files.atomic_writing import atomic_file
from transport.protocol.scenario.setup.run_setup import Setup

# Width of every figure: a column of a paper (8.5 cm), inches.
COLUMN_IN = 3.35
POINTS_PER_IN = 72.0
# Settings of matplotlib; the type depends on its version.
RC: Any = rc_params_from_file(
    Path(__file__).with_name("figures.mplstyle"), use_default_template=False
)
# Sizes of text in print, points: titles and labels, numbers at axes and legends.
TEXT = RC["font.size"]
SMALL = RC["legend.fontsize"]

# Colours of components (x, y, z; roll, pitch, yaw), different from those of UAVs, and in grey from
# each other.
COMPONENTS = ("#000000", "#E69F00", "#7B52AB")
PAYLOAD = "#000000"
REFERENCE = "#8c8c8c"
_BAND = "#f1f1f1"

# Colours of curves differ for colour-blind readers (after Okabe and Ito 2008) and in grey:
# lightness L* 29, 54, 70, 0, 61.
_COLOURS = ("#004488", "#D55E00", "#56B4E9", "#000000", "#CC79A7")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
LINES = ("-", "--", "-.", ":")


MARKER = 3.2  # size, points


class Look(NamedTuple):
    """Colour, marker and line of a curve, or of the marks of a name."""

    colour: str
    marker: str
    line: str

    def style(self, line: str = "none") -> dict[str, Any]:
        """Return the style of its marks in matplotlib, joined by a line or by none."""
        return {
            "color": self.colour,
            "marker": self.marker,
            "markersize": MARKER,
            "linestyle": line,
        }


def _curve(i: int) -> Look:
    """Return the look of curve i; another line where colours repeat."""
    cycle, colour = divmod(i, len(_COLOURS))
    return Look(_COLOURS[colour], _MARKERS[i], LINES[(i + cycle) % len(LINES)])


CURVES = tuple(_curve(i) for i in range(len(_MARKERS)))  # looks of ten curves
# Looks of what many figures show, the same in each, by name: controllers and networks.
_KNOWN = {
    "centralized": Look("#000000", "D", "-"),
    "centralized_lq": Look("#CC79A7", "v", ":"),
    "paper": Look("#004488", "o", "-"),
    "paper's algorithm": Look("#004488", "o", "-"),
    "resilient": Look("#D55E00", "s", "--"),
    "closed loop": Look("#D55E00", "s", "--"),
    "precise": Look("#56B4E9", "^", "-."),
    "alone": Look("#117733", "P", ":"),
    "perfect": CURVES[0],
    "late": CURVES[1],
    "200 ms delay": CURVES[1],
    "200 ms delay, 30 % loss": CURVES[1],
    "bursts": CURVES[2],
    "radio": CURVES[3],
}
# Marker of a diverged run, in every figure: hollow.
DIVERGED: Any = {"markerfacecolor": "#ffffff", "linestyle": "none"}

# Fields of files that name program and date.
_UNNAMED = {
    ".png": ("Software",),
    ".svg": ("Date", "Creator"),
    ".pdf": ("CreationDate", "Creator", "Producer"),
}
# Names of phases: distance from the panel, points; width of a letter, in font sizes.
_ABOVE_PT = 11.0
_LETTER = 0.62
# Costs below it are rounding errors, such as those of a team at rest.
LEAST_COST = 1e-6


def looks_of(names: Sequence[str]) -> dict[str, Look]:
    """Return the look of each of names: known ones have always the same.

    Others have the rest of the ten curves, and repeat them after that: nine beside `paper` differ.
    Of more names than colours, all of which have parts between commas, the first part has a colour, and
    the others together have a marker and a line.
    """
    if len(names) > len(_COLOURS) and all(", " in name for name in names):
        parts = [name.split(", ", 1) for name in names]
        colours = list(dict.fromkeys(first for first, _ in parts))
        shapes = list(dict.fromkeys(others for _, others in parts))
        if len(colours) <= len(_COLOURS):
            return {
                name: CURVES[shapes.index(others)]._replace(colour=_COLOURS[colours.index(first)])
                for name, (first, others) in zip(names, parts, strict=True)
            }

    known = [_KNOWN[name] for name in names if name in _KNOWN]
    taken = {(look.colour, look.marker) for look in known}
    free = itertools.cycle(look for look in CURVES if (look.colour, look.marker) not in taken)
    return {name: _KNOWN[name] if name in _KNOWN else next(free) for name in names}


def line_width(i: int, count: int, widest: float) -> float:
    """Return the width of curve i, points.

    It decreases, so that curves that coincide stay visible.
    """
    if count == 1:
        return 1.0
    return widest - (widest - 1.0) * i / (count - 1)


def shade_phases(setup: Setup, panels: list[Axes], until_s: float, *, named: bool = True) -> None:
    """Shade every other phase of the maneuver in stacked panels over time.

    Those with room have their names above the first panel.
    """
    width_pt = POINTS_PER_IN * panels[0].get_window_extent().width / panels[0].figure.dpi
    points_per_s = width_pt / until_s
    for number, (phase, begin, end) in enumerate(setup.maneuver.stages()):
        shown_end = min(end, until_s)
        if shown_end <= begin:
            break
        if number % 2:
            for axes in panels:
                axes.axvspan(begin, shown_end, color=_BAND, linewidth=0, zorder=0)

        # Neighbouring names must not touch: one without room is left out.
        room_pt = points_per_s * (shown_end - begin)
        if named and len(phase) * _LETTER * SMALL <= room_pt:
            _name_phase(panels[0], phase, (begin + shown_end) / 2.0)

    for axes in panels:
        axes.set_xlim(0.0, until_s)


def _name_phase(panel: Axes, phase: str, middle_s: float) -> None:
    """Write the name of a phase above a panel."""
    up = ScaledTranslation(0.0, _ABOVE_PT / POINTS_PER_IN, panel.figure.dpi_scale_trans)
    above = panel.get_xaxis_transform() + up
    style: Any = {"ha": "center", "va": "bottom", "color": "#555555", "fontsize": SMALL}
    panel.text(middle_s, 1.0, phase, transform=above, **style)


class _PlainTicks(LogLocator):
    """Ticks of a logarithmic axis: the fewest round numbers of each decade of which enough are shown."""

    _ROUND = (
        (1.0, 2.0, 5.0),
        (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
        (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0),
    )
    _ENOUGH = 4

    def tick_values(self, vmin: float, vmax: float) -> Sequence[float]:
        """Return the ticks between two values, and perhaps beyond."""
        low, high = sorted((vmin, vmax))
        ticks: list[float] = []
        for numbers in self._ROUND:
            self.set_params(subs=numbers)
            ticks = list(super().tick_values(low, high))
            if sum(low <= tick <= high for tick in ticks) >= self._ENOUGH:
                break
        return ticks


def label_decades(axis: Axis) -> None:
    """Label a logarithmic axis of few decades with plain numbers, also within a decade."""
    axis.set_major_locator(_PlainTicks())
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_locator(NullLocator())


def scale_cost(axes: Axes, top: float, decades: int) -> None:
    """Set a logarithmic axis that shows so many decades of costs up to `top`.

    A run without cost keeps its axis.
    """
    if 0.0 < top < np.inf:
        top = max(top, LEAST_COST)
        axes.set_yscale("log")
        axes.set_ylim(top * 10.0**-decades, top * 2.0)


def save(figure: Figure, path: Path, also: Collection[str] = ("svg",)) -> list[Path]:
    """Write a figure as PNG, and also as "svg" or "pdf"; return the files.

    The files are without program and date: equal figures give equal files.
    """
    endings = (".png", *(f".{kind}" for kind in also))
    files = [path.with_suffix(ending) for ending in endings]
    for file in files:
        unnamed = dict.fromkeys(_UNNAMED[file.suffix])
        kind = file.suffix.removeprefix(".")
        with atomic_file(file) as stream:
            figure.savefig(stream, format=kind, metadata=unnamed, dpi=RC["savefig.dpi"])
    return files
