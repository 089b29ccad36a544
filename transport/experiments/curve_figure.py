"""Curve figure: completed runs, cost and attitude over the varied quantity, with confidence intervals."""

import math
import statistics
from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from transport.experiments.experiment import NONE, Experiment
from transport.experiments.statistics import PointStatistics
from transport.report.style import CURVES, WIDTH_IN, label_decades

MARKER, PRINT = 4.0, 7.0

# Panels: title, number, factor.
_PANELS = (("mean cost ($10^{-3}$)", "cost_mean", 1e3), ("largest payload\nattitude (deg)", "attitude_max_deg", 1.0))

# Height of a panel and of everything around the panels, in; relative height of the survival panel.
_PANEL_IN, _AROUND_IN, _LOW = 1.55, 0.9, 0.6

# Horizontal offset between curves, as a share of the axis, so that error bars do not overlap.
_APART = 0.02

# Limits of the upper end of the vertical axis over the highest mean; wide intervals, as of two runs, are cut off.
_HIGHEST, _LOWEST = 2.0, 1.1

# A mean this many times the median makes the axis logarithmic, down to this share of the highest mean.
_OUTLIER, _SHOWN = 5.0, 0.01

# More values than this get round ticks instead of one each.
_MOST_TICKS = 10


def draw_curves(figure: Figure, experiment: Experiment, measured: Sequence[PointStatistics]) -> None:
    """Draw a column of panels for each scenario, or one column if each scenario is a single curve."""
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    columns = [scenarios] if experiment.curves is None else [[scenario] for scenario in scenarios]
    any_diverged = any(m.completed < m.runs for m in measured)
    heights = [_LOW] * any_diverged + [1.0] * len(_PANELS)
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
            style = curve_style(index)
            if isinstance(values[0], str) or len(values) > _MOST_TICKS:
                style["linestyle"] = "none"  # no line between names or between random times
            shift = apart * (index - (len(curves) - 1) / 2.0)
            x = [places[m.point.labels[experiment.x.label]] + shift for m in points]
            if any_diverged:
                _draw_survival(column[0], x, points, style, index)
            for panel, (_, number, factor) in zip(column[any_diverged:], _PANELS, strict=True):
                draw_means(panel, x, points, number, factor, {**style, "label": name})
        column[-1].set_xlabel(experiment.x.title)
        if len(values) <= _MOST_TICKS:
            column[-1].set_xticks(list(places.values()), [_tick(value, experiment.x.factor) for value in values])
        else:
            column[-1].xaxis.set_major_formatter(lambda value, _: _tick(value, experiment.x.factor))
        if len(columns) > 1:
            column[0].set_title(names[0])
    for panel, (title, number, factor) in zip(panels[any_diverged:, 0], _PANELS, strict=True):
        panel.set_ylabel(title)
        _scale(panel, [factor * value.mean for m in measured if (value := m.numbers[number]) is not None])
    if any_diverged:
        panels[0, 0].set_ylabel("runs\ncompleted (%)")
        panels[0, 0].set_ylim(-15.0, 130.0)
        panels[0, 0].set_yticks([0, 50, 100])
    figure.align_ylabels(panels[:, 0])
    draw_legend(figure, panels[-1, 0], columns=4)


def curve_style(index: int) -> dict[str, Any]:
    """Return colour, marker and line style of a curve."""
    return dict(zip(("color", "marker", "linestyle"), CURVES[index % len(CURVES)], strict=True))


def draw_legend(figure: Figure, *panels: Axes, columns: int = 99) -> None:
    """Draw one legend above all panels, each label once, in at most so many columns."""
    handles: dict[str, Any] = {}
    for panel in panels:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=min(len(handles), columns))


def _curves(experiment: Experiment, measured: Sequence[PointStatistics]) -> dict[str, list[PointStatistics]]:
    """Return the points of each curve by its name in the legend, in the order of the horizontal axis."""
    column = experiment.curves
    if column is None:
        names = dict.fromkeys(m.point.scenario for m in measured)
        return {name: [m for m in measured if m.point.scenario == name] for name in names}
    values = dict.fromkeys(m.point.labels[column] for m in measured)
    curves = {}
    for value in (value for value in values if value != NONE):
        # The last of several points at one x belongs to the curve: the constant delay, not the perfect network.
        own = {m.point.labels[experiment.x.label]: m for m in measured if m.point.labels[column] in (NONE, value)}
        curves[experiment.legend.get(value, str(value))] = list(own.values())
    return curves


def _scale(axes: Axes, means: Sequence[float]) -> None:
    """Fit the vertical axis to the means; logarithmic if a few nearly diverged runs are far above the rest."""
    highest = max(means, default=0.0)
    top = min(max(axes.get_ylim()[1], _LOWEST * highest), _HIGHEST * highest)
    if highest > _OUTLIER * statistics.median(means or [0.0]):
        axes.set_yscale("log")
        axes.set_ylim(max(min(means), _SHOWN * highest) / 1.5, top)
        label_decades(axes.yaxis)
    else:
        axes.set_ylim(0.0, top or 1.0)


def _draw_survival(
    axes: Axes, x: Sequence[float], points: Sequence[PointStatistics], style: dict[str, Any], index: int
) -> None:
    """Draw the share of completed runs; a cross where any diverged, with the time of a single run."""
    shares = [100.0 * m.completed / m.runs if m.runs else math.nan for m in points]
    axes.plot(x, shares, color=style["color"], linestyle=style["linestyle"])
    for at, share, m in zip(x, shares, points, strict=True):
        marker = "x" if share < 100.0 else style["marker"]
        axes.plot([at], [share], color=style["color"], marker=marker, markersize=MARKER, markeredgewidth=1.5)
        if m.runs == 1 and m.diverged_s:
            # One line of text for each curve, above all crosses.
            above = (0.0, 1.5 * MARKER + 1.1 * PRINT * index)
            text, colour = f"{m.diverged_s[0]:.1f} s", style["color"]
            how: Any = {"textcoords": "offset points", "ha": "center", "color": colour, "fontsize": PRINT}
            axes.annotate(text, (at, share), above, **how)


def draw_means(
    axes: Axes, x: Sequence[float], points: Sequence[PointStatistics], number: str, factor: float, style: dict[str, Any]
) -> list[float]:
    """Draw and return means over the completed runs, with confidence intervals; nan where no run was completed."""
    means, halves = [], []
    for m in points:
        value = m.numbers[number]
        means.append(math.nan if value is None else factor * value.mean)
        halves.append(0.0 if value is None or value.half_width is None else factor * value.half_width)
    axes.plot(x, means, **style, markersize=MARKER)
    axes.errorbar(x, means, halves, color=style["color"], linestyle="none", capsize=2.0, elinewidth=0.8)
    return means


def _tick(value: str | float, factor: float) -> str:
    return value if isinstance(value, str) else f"{factor * value:g}"
