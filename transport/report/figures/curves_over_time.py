"""Curves over time of UAVs and components, and the least ranges of their axes."""

from collections.abc import Sequence
from typing import Any, Protocol

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.figures.column import MOST_BESIDE, label_ends, strips
from transport.report.figures.style import COMPONENTS, SMALL, line_width
from transport.scene.uav_and_link_colours import uav_style

# Smallest ranges of the axes, either side of zero: smaller errors are negligible.
LEAST_M = 1e-3
LEAST_DEG = 1e-2
LEAST_INPUT = 1e-3  # N and N m

ANGLES = ("roll", "pitch", "yaw")
PLACES = ("x", "y", "z (down)")
BY_COMPONENT: list[dict[str, Any]] = [{"color": colour} for colour in COMPONENTS]

# Most UAVs that have a strip each, and the height of one, inches.
MOST_STRIPS = 4
STRIP_IN = 0.3

# Widths of the first of several curves, points.
WIDE = 1.8
WIDER = 2.6


class Panels(Protocol):
    """A function that makes the panels of a figure, given their heights, inches."""

    def __call__(self, heights_in: Sequence[float], *, legend: Sequence[Line2D] = ()) -> list[Axes]:
        """Return stacked panels with a legend above them."""


def plot_components(
    panel: Axes,
    times_s: Array,
    values: Array,
    names: Sequence[str],
) -> None:
    """Plot three components, (T, 3), over time."""
    _plot(panel, times_s, values, dict(zip(names, BY_COMPONENT, strict=True)), WIDE)


def plot_uavs(panel: Axes, times_s: Array, values: Array, widest: float = WIDE) -> list[Axes]:
    """Plot a value of each UAV, (T, N), over time; return the panels.

    Few UAVs have a strip each, with equal axes, as their curves often coincide; more share the panel.
    """
    styles = {f"UAV{i + 1}": uav_style(i) for i in range(values.shape[1])}
    if len(styles) > MOST_STRIPS:
        _plot(panel, times_s, values, styles, widest)
        return [panel]

    panels = strips(panel, len(styles))
    for i, (one, (name, style)) in enumerate(zip(panels, styles.items(), strict=True)):
        one.plot(times_s, values[:, i], linewidth=1.0, **style)
        colour = style["color"]
        one.text(
            0.006, 0.02, name, transform=one.transAxes, va="bottom", fontsize=SMALL, color=colour
        )
    ends = [end for one in panels for end in one.get_ylim()]
    for one in panels:
        one.set_ylim(min(ends), max(ends))
        label_ends(one)
    return panels


def height_of_uavs_in(setup: Setup, shared_in: float) -> float:
    """Return the height of the panels of a value of each UAV, inches; that of one panel if they share it."""
    N = setup.system.N
    return STRIP_IN * N if 1 < N <= MOST_STRIPS else shared_in


def _plot(
    panel: Axes,
    times_s: Array,
    values: Array,
    styles: dict[str, dict[str, Any]],
    widest: float,
) -> None:
    """Plot values, (T, k), over time, so that curves that coincide stay visible.

    The k curves have styles by name.
    """
    for i, (name, style) in enumerate(styles.items()):
        width = line_width(i, len(styles), widest)
        panel.plot(times_s, values[:, i], label=name, linewidth=width, **style)


def long_legend(setup: Setup) -> list[Line2D]:
    """Return a legend of the UAVs for the top of a figure if it is too long beside a title.

    The curve of an agent looks like that of its first UAV.
    """
    N = setup.system.N
    if N <= MOST_BESIDE:
        return []
    return [Line2D([], [], label=f"UAV{i + 1}", **uav_style(i)) for i in range(N)]
