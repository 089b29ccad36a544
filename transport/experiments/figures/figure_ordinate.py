"""Vertical axis of curves: its scale, about means with their error bars, or about the times of divergence."""

import statistics
from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from transport.report.figures.style import label_decades

# Means that far above their median are nearly diverged runs: the axis becomes logarithmic.
_FAR_ABOVE = 5.0
# Ends of a vertical axis: of one from zero over its highest mean, so that the marker is within it; the most
# of it that error bars can ask for, beyond which they leave the panel; of a logarithmic one over its highest
# mean, and below its lowest by the same factor; of ratios, about which zero tells nothing, as a share of the data.
_ABOVE_HIGHEST = 1.12
_MOST_FOR_BARS = 2.0
_BEYOND_DECADES = 1.4
_ABOUT_RATIOS = 0.12
# Height of "never" over the latest divergence, and highest tick below it.
NEVER = 1.25
_HIGHEST_TICK = 0.85


class DrawnMean(NamedTuple):
    """A drawn mean, and the ends of its error bar."""

    mean: float
    low: float
    high: float


def scale_to_means(
    axes: Axes, drawn: Sequence[DrawnMean], *, is_ratio: bool, is_growth: bool
) -> None:
    """Fit the vertical axis to the means that are drawn, and to their error bars as far as they leave these readable.

    It is logarithmic for growth, and if few means are far above the rest; about the data for ratios; else it
    begins at zero.
    """
    means = [one.mean for one in drawn] or [0.0]
    lowest = min(means)
    highest = max(means)
    if is_ratio:
        axes.margins(y=_ABOUT_RATIOS)
    elif lowest > 0.0 and (is_growth or highest > _FAR_ABOVE * statistics.median(means)):
        axes.set_yscale("log")
        lowest = min((one.low for one in drawn if one.low > 0.0), default=lowest)
        top = min(max(one.high for one in drawn), _MOST_FOR_BARS * highest)
        axes.set_ylim(lowest / _BEYOND_DECADES, _BEYOND_DECADES * top)
        label_decades(axes.yaxis)
    elif highest > 0.0:
        with_bars = axes.get_ylim()[1]  # of matplotlib, with its own margin
        top = max(with_bars, _ABOVE_HIGHEST * highest)
        axes.set_ylim(0.0, min(top, _MOST_FOR_BARS * highest))
    else:
        axes.set_ylim(0.0, 1.0)  # all are zero


def scale_to_ends(axes: Axes, never_s: float) -> None:
    """Let the axis begin at zero, and name the height at which runs that complete are drawn."""
    axes.set_ylim(0.0, _ABOVE_HIGHEST * never_s)
    highest_s = _HIGHEST_TICK * never_s
    ticks_s = [tick for tick in MaxNLocator(4).tick_values(0.0, never_s) if tick < highest_s]
    axes.set_yticks([*ticks_s, never_s], [*(f"{tick:g}" for tick in ticks_s), "never"])
