"""Colours of numbers: a logarithmic scale, and its bar beside the panels."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from transport.report.figures.style import COLUMN_IN

# Distance of the colour bar from the panels, and its width, inches.
_BAR_GAP_IN = 0.08
_BAR_IN = 0.09
# Ratio of the ends of a scale, at least: that of equal numbers has a length, too.
_LEAST_SPAN = 1.001


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
