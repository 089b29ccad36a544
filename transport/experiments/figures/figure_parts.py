"""Parts that the figures of experiments share: values of a column, the style of marks, colours of numbers."""

from collections.abc import Iterable, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from transport.experiments.statistics import PointStatistics
from transport.report.figures.style import COLUMN_IN, MARKER

# Distance of the colour bar from the panels, and its width, inches.
_BAR_GAP_IN = 0.08
_BAR_IN = 0.09
_LEAST_SPAN = (
    1.001  # ratio of the ends of a scale, at least: that of equal numbers has a length, too
)


def values_of(measured: Iterable[PointStatistics], column: str) -> list[str | float]:
    """Return the values of a column of points, each once, in their order."""
    return list(dict.fromkeys(one.point.labels[column] for one in measured))


def mark_style(look: tuple[str, str, str], line: str = "none") -> dict[str, Any]:
    """Return the style of marks with the colour and marker of a look, joined by a line or by none."""
    colour, marker, _ = look
    return {"color": colour, "marker": marker, "markersize": MARKER, "linestyle": line}


def scale_of(numbers: Sequence[float], most_decades: float | None = None) -> LogNorm:
    """Return a logarithmic scale of colours over all numbers above zero, of so many decades at most.

    Without any such number it is one about 1.
    """
    positive = [number for number in numbers if number > 0.0] or [1.0]
    lowest = min(positive)
    highest = max(*positive, _LEAST_SPAN * lowest)
    if most_decades is not None:
        lowest = max(lowest, highest / 10.0**most_decades)
    return LogNorm(lowest, highest)


def draw_colour_bar(figure: Figure, panels: Sequence[Axes], scale: LogNorm) -> Colorbar:
    """Draw the colour bar of a scale to the right of panels below each other; return it."""
    highest = panels[0].get_position()
    lowest = panels[-1].get_position()
    left = highest.x1 + _BAR_GAP_IN / COLUMN_IN
    place = (left, lowest.y0, _BAR_IN / COLUMN_IN, highest.y1 - lowest.y0)
    return figure.colorbar(ScalarMappable(scale), cax=figure.add_axes(place))
