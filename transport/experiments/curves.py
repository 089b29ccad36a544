"""Curves over what an experiment changed: survival, cost, attitude, with confidence intervals."""

import math
import statistics
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from transport.experiments.catalogue import NOBODY, Experiment
from transport.experiments.statistics import Measured
from transport.report.style import CURVES, WIDTH_IN, label_decades

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKER, PRINT = 4.0, 7.0

# What is drawn against the sweep: title, number, factor.
_PANELS = (("mean cost ($10^{-3}$)", "cost_mean", 1e3), ("largest payload\nattitude (deg)", "attitude_max_deg", 1.0))

# Height of a panel and of all that is around them, in; height of the panel of survival, in panels.
_PANEL_IN, _AROUND_IN, _LOW = 1.55, 0.9, 0.6

# Curves are drawn this share of the axis apart, so that error bars do not hide each other.
_APART = 0.02

# An interval of two flights may be wider than all there is to see; then it leaves the panel, at this many means.
_HIGHEST = 2.0
# The least room above the highest mean, for its marker.
_ABOVE = 1.1

# A mean so many times the median makes the axis logarithmic; it then shows this share of the highest at least.
_DWARFS, _SHOWN = 5.0, 0.01

# More values than this have ticks at round numbers instead of one each.
_MOST_TICKS = 10


def draw_curves(figure: "Figure", experiment: Experiment, measured: Sequence[Measured]) -> None:
    """A column of panels for each scenario, or one column for all when each is a single curve.

    Args:
        figure: Empty.
        experiment: What was flown.
        measured: What came of each point.
    """
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    columns = [scenarios] if experiment.curves is None else [[scenario] for scenario in scenarios]
    some_lost = any(m.completed < m.flights for m in measured)
    heights = [_LOW] * some_lost + [1.0] * len(_PANELS)
    figure.set_size_inches(WIDTH_IN, _PANEL_IN * sum(heights) + _AROUND_IN)
    panels = figure.subplots(
        len(heights), len(columns), sharex=True, sharey="row", squeeze=False, height_ratios=heights
    )
    for names, column in zip(columns, panels.T, strict=True):
        shown = [m for m in measured if m.point.scenario in names]
        values = list(dict.fromkeys(m.point.labels[experiment.x.label] for m in shown))
        places = {value: value if isinstance(value, float) else float(i) for i, value in enumerate(values)}
        curves = _curves(experiment, shown)
        apart = _APART * max(places.values()) if len(columns) > 1 else 0.0
        for index, (name, points) in enumerate(curves.items()):
            style = dict(zip(("color", "marker", "linestyle"), CURVES[index % len(CURVES)], strict=True))
            if isinstance(values[0], str) or len(values) > _MOST_TICKS:
                style["linestyle"] = "none"  # nothing lies between two names, or between random instants
            shift = apart * (index - (len(curves) - 1) / 2.0)
            x = [places[m.point.labels[experiment.x.label]] + shift for m in points]
            if some_lost:
                _draw_survival(column[0], x, points, style, index)
            for panel, (_, number, factor) in zip(column[some_lost:], _PANELS, strict=True):
                _draw_means(panel, x, points, number, factor, {**style, "label": name})
        column[-1].set_xlabel(experiment.x.title)
        if len(values) <= _MOST_TICKS:
            column[-1].set_xticks(list(places.values()), [_tick(value, experiment.x.factor) for value in values])
        else:
            column[-1].xaxis.set_major_formatter(lambda value, _: _tick(value, experiment.x.factor))
        if len(columns) > 1:
            column[0].set_title(names[0])
    for panel, (title, number, factor) in zip(panels[some_lost:, 0], _PANELS, strict=True):
        panel.set_ylabel(title)
        _scale(panel, [factor * value.mean for m in measured if (value := m.numbers[number]) is not None])
    if some_lost:
        panels[0, 0].set_ylabel("flights\ncompleted (%)")
        panels[0, 0].set_ylim(-15.0, 130.0)
        panels[0, 0].set_yticks([0, 50, 100])
    figure.align_ylabels(panels[:, 0])
    handles, labels = panels[-1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 4))


def _curves(experiment: Experiment, measured: Sequence[Measured]) -> dict[str, list[Measured]]:
    """The points of each curve by its name in the legend, in the order of the horizontal axis."""
    column = experiment.curves
    if column is None:
        names = dict.fromkeys(m.point.scenario for m in measured)
        return {name: [m for m in measured if m.point.scenario == name] for name in names}
    values = dict.fromkeys(m.point.labels[column] for m in measured)
    curves = {}
    for value in (value for value in values if value != NOBODY):
        # Of points at one place the last is nearest to the curve: a constant delay rather than none.
        own = {m.point.labels[experiment.x.label]: m for m in measured if m.point.labels[column] in (NOBODY, value)}
        curves[experiment.legend.get(value, str(value))] = list(own.values())
    return curves


def _scale(axes: "Axes", means: Sequence[float]) -> None:
    """Fit the vertical axis to the means drawn; logarithmic where a few flights that nearly failed dwarf the rest."""
    highest = max(means, default=0.0)
    top = min(max(axes.get_ylim()[1], _ABOVE * highest), _HIGHEST * highest)
    if highest > _DWARFS * statistics.median(means or [0.0]):
        axes.set_yscale("log")
        axes.set_ylim(max(min(means), _SHOWN * highest) / 1.5, top)
        label_decades(axes.yaxis)
    else:
        axes.set_ylim(0.0, top or 1.0)


def _draw_survival(
    axes: "Axes", x: Sequence[float], points: Sequence[Measured], style: dict[str, Any], index: int
) -> None:
    """Share of the flights that were completed; a cross where any was lost, with the time if there is but one."""
    shares = [100.0 * m.completed / m.flights if m.flights else math.nan for m in points]
    axes.plot(x, shares, color=style["color"], linestyle=style["linestyle"])
    for at, share, m in zip(x, shares, points, strict=True):
        marker = "x" if share < 100.0 else style["marker"]
        axes.plot([at], [share], color=style["color"], marker=marker, markersize=MARKER, markeredgewidth=1.5)
        if m.flights == 1 and m.lost_s:
            # One line of print for each curve, above the crosses of all.
            above = (0.0, 1.5 * MARKER + 1.1 * PRINT * index)
            text, colour = f"{m.lost_s[0]:.1f} s", style["color"]
            how: Any = {"textcoords": "offset points", "ha": "center", "color": colour, "fontsize": PRINT}
            axes.annotate(text, (at, share), above, **how)


def _draw_means(
    axes: "Axes", x: Sequence[float], points: Sequence[Measured], number: str, factor: float, style: dict[str, Any]
) -> None:
    """Means over the completed flights with their confidence intervals; nothing where none was."""
    means, halves = [], []
    for m in points:
        value = m.numbers[number]
        means.append(math.nan if value is None else factor * value.mean)
        halves.append(0.0 if value is None or value.half_width is None else factor * value.half_width)
    axes.plot(x, means, **style, markersize=MARKER)
    axes.errorbar(x, means, halves, color=style["color"], linestyle="none", capsize=2.0, elinewidth=0.8)


def _tick(value: str | float, factor: float) -> str:
    return value if isinstance(value, str) else f"{factor * value:g}"
