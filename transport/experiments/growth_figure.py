"""How computation, messages and cost grow with the team: panels over N, with slopes to compare with."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from transport.experiments.catalogue import CENTRALIZED
from transport.experiments.curves import MARKER, PRINT
from transport.experiments.growth import FEWEST
from transport.experiments.statistics import Measured
from transport.report.style import CURVES, REFERENCE, WIDTH_IN, label_decades

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_HEIGHT_IN = 4.6

# The axis goes on by this factor behind the largest team, where the slopes have their names.
_ROOM = 1.3
# The axes up end this factor beyond means and slopes; wider intervals leave the panel, that of two flights by far.
_MARGIN = 1.4
# Sizes of teams closer than this factor leave no room for both their names.
_CLOSE = 1.25


class _Panel(NamedTuple):
    """Title, number, factor, and by ownership the exponent of the slope drawn beside its curve."""

    title: str
    name: str
    factor: float
    slopes: Mapping[str, float]


_PANELS = (
    _Panel("CPU, agent's step (ms)", "cpu_step_p50_ms", 1.0, {"distributed": 1.5, CENTRALIZED: 3.0}),
    _Panel("CPU, team per tick (ms)", "cpu_team_tick_ms", 1.0, {"distributed": 2.5, CENTRALIZED: 3.0}),
    _Panel("plans between agents (kB/s)", "plan_bytes_per_s", 1e-3, {"distributed": 2.0}),
    _Panel("mean cost ($10^{-3}$)", "cost_mean", 1e3, {}),
)


def draw_growth(figure: "Figure", measured: Sequence[Measured]) -> None:
    """Four panels over the number of UAVs, a curve for each ownership.

    Args:
        figure: Empty.
        measured: What came of each point.
    """
    from matplotlib.ticker import NullLocator

    figure.set_size_inches(WIDTH_IN, _HEIGHT_IN)
    panels = figure.subplots(2, 2, sharex=True)
    ownerships = list(dict.fromkeys(m.point.labels["ownership"] for m in measured))
    sizes = sorted({int(m.point.labels["uavs"]) for m in measured})
    for axes, panel in zip(panels.flat, _PANELS, strict=True):
        axes.set_xscale("log")
        heights: list[float] = []
        for index, ownership in enumerate(ownerships):
            own = [m for m in measured if m.point.labels["ownership"] == ownership]
            heights += _draw(axes, panel, own, str(ownership), index)
        axes.set_title(panel.title)
        axes.set_yscale("log")
        if heights:
            axes.set_ylim(min(heights) / _MARGIN, max(heights) * _MARGIN)
        label_decades(axes.yaxis)
        axes.set_xticks(sizes, _names(sizes))
        axes.xaxis.set_minor_locator(NullLocator())
    for axes in panels[-1]:
        axes.set_xlabel("UAVs")
        axes.set_xlim(sizes[0] / _ROOM**0.3, sizes[-1] * _ROOM)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))


def _names(sizes: Sequence[int]) -> list[str]:
    """What is written below each size, ascending: nothing where the next one's name needs the room."""
    names: list[str] = []
    named = math.inf
    for size in reversed(sizes):
        has_room = named > _CLOSE * size
        names.insert(0, str(size) if has_room else "")
        named = size if has_room else named
    return names


def _draw(axes: "Axes", panel: _Panel, measured: Sequence[Measured], name: str, index: int) -> list[float]:
    """A curve with its confidence intervals, and the slope to compare it with; the heights to be seen."""
    found = [(int(m.point.labels["uavs"]), value) for m in measured if (value := m.numbers[panel.name]) is not None]
    shown = [(uavs, value) for uavs, value in found if value.mean > 0.0]
    if not shown:
        return []
    x = [uavs for uavs, _ in shown]
    y = [panel.factor * value.mean for _, value in shown]
    halves = [panel.factor * (value.half_width or 0.0) for _, value in shown]
    colour, marker, line = CURVES[index % len(CURVES)]
    style: dict[str, Any] = {"color": colour, "marker": marker, "linestyle": line, "markersize": MARKER}
    axes.plot(x, y, **style, label=name)
    axes.errorbar(x, y, halves, color=colour, linestyle="none", capsize=2.0, elinewidth=0.8)
    if name in panel.slopes and x[-1] > FEWEST:
        power = panel.slopes[name]
        first = next(i for i, uavs in enumerate(x) if uavs >= FEWEST)
        end = y[first] * (x[-1] / x[first]) ** power
        axes.plot([x[first], x[-1]], [y[first], end], color=REFERENCE, linestyle=":", linewidth=1.0, zorder=1.0)
        how: Any = {"textcoords": "offset points", "ha": "left", "va": "center", "color": REFERENCE}
        axes.annotate(f"$N^{{{power:g}}}$", (x[-1], end), (5.0, 0.0), **how, fontsize=PRINT)
        return [*y, end]
    return y
