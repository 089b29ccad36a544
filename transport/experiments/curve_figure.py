"""Curve figure: time of divergence, cost and attitude over the varied quantity, with confidence intervals.

One column of a paper wide. A scenario has a colour, a curve of it (a distribution, a kind of loss) a marker and a line.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from transport.experiments.experiment import NONE, Experiment
from transport.experiments.statistics import PointStatistics
from transport.report.column import column_panels, head
from transport.report.style import CURVES, label_decades

MARKER, PRINT = 4.0, 7.0

# Panels: title, number, factor.
_PANELS = (
    ("mean cost of completed runs ($10^{-3}$)", "cost_mean", 1e3),
    ("largest payload attitude (deg)", "attitude_max_deg", 1.0),
)
_DIVERGED = "runs diverge at (s, hollow), or never"

# Height of a panel and of a row of the legend, in.
_PANEL_IN, _ROW_IN = 0.95, 0.14

# Distance between neighbouring curves, as a share of the axis, so that markers and error bars do not overlap; less
# where many values are near each other.
_APART, _APART_MANY = 0.022, 0.004

# Height of a run that never diverges, over the time of the last divergence.
_NEVER = 1.25

# Limits of the upper end of the vertical axis over the highest mean; wide intervals, as of two runs, are cut off.
_HIGHEST, _LOWEST = 2.0, 1.1

# A mean this many times the median makes the axis logarithmic, down to this share of the highest mean.
_OUTLIER, _SHOWN = 5.0, 0.01

# More values than this get round ticks instead of one each.
_MOST_TICKS = 10


def draw_curves(figure: Figure, experiment: Experiment, measured: Sequence[PointStatistics]) -> None:
    """Draw the panels: when runs diverge, if any does, cost and attitude; each with the curves of all scenarios."""
    figure.set_layout_engine("none")
    curves = _styled_curves(experiment, measured)
    values = list(dict.fromkeys(m.point.labels[experiment.x.label] for m in measured))
    places = {value: value if isinstance(value, float) else float(i) for i, value in enumerate(values)}
    joined = not isinstance(values[0], str) and len(values) <= _MOST_TICKS  # no line between names or random times
    diverged_s = [time_s for m in measured for time_s in m.diverged_s]
    rows = _legend_rows(curves, joined=joined)
    panels = column_panels(figure, len(_PANELS) + bool(diverged_s), _PANEL_IN, top_in=0.22 + _ROW_IN * len(rows))
    apart = (_APART if len(values) <= _MOST_TICKS else _APART_MANY) * max([1e-9, *places.values()])
    for index, (points, style) in enumerate(curves):
        shift = apart * (index - (len(curves) - 1) / 2.0)
        x = [places[m.point.labels[experiment.x.label]] + shift for m in points]
        line = style if joined else {**style, "linestyle": "none"}
        if diverged_s:
            _draw_divergence(panels[0], x, points, line, _NEVER * max(diverged_s))
        for panel, (_, number, factor) in zip(panels[bool(diverged_s) :], _PANELS, strict=True):
            draw_means(panel, x, points, number, factor, line)
    for panel in panels:
        panel.set_xlim(_ends(list(places.values()), apart * (len(curves) + 1)))
        panel.set_xticks([])
    for panel, (title, number, factor) in zip(panels[bool(diverged_s) :], _PANELS, strict=True):
        head(panel, title, legend=False)
        _scale(panel, [factor * value.mean for m in measured if (value := m.numbers[number]) is not None])
    if diverged_s:
        head(panels[0], _DIVERGED, legend=False)
        _name_never(panels[0], _NEVER * max(diverged_s))
    for panel in panels:
        _name_values(panel, experiment, places)
    panels[-1].set_xlabel(experiment.x.title, fontsize=PRINT)
    _draw_legend_rows(figure, rows)


def _styled_curves(
    experiment: Experiment, measured: Sequence[PointStatistics]
) -> list[tuple[list[PointStatistics], dict[str, Any]]]:
    """Return the points of each curve of each scenario, and its style."""
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    found = []
    for place, scenario in enumerate(scenarios):
        colour = CURVES[place % len(CURVES)][0]
        own = _curves(experiment, [m for m in measured if m.point.scenario == scenario])
        for index, (name, points) in enumerate(own.items()):
            shape = index if experiment.curves is not None else place
            if len(scenarios) == 1:  # nothing else to tell by colour
                colour = CURVES[shape % len(CURVES)][0]
            _, marker, line = CURVES[shape % len(CURVES)]
            style = {"color": colour, "marker": marker, "linestyle": line, "label": f"{scenario}\n{name}"}
            found.append((points, style))
    return found


def _legend_rows(curves: Sequence[tuple[list[PointStatistics], dict[str, Any]]], *, joined: bool) -> list[list[Line2D]]:
    """Return the handles of each row of the legend: scenarios by colour, then curves by marker, two in a row."""
    colours, shapes = {}, {}
    for _, style in curves:
        scenario, name = style["label"].split("\n")
        colours[scenario] = style["color"]
        if name != scenario:
            shapes[name] = {"marker": style["marker"], "linestyle": style["linestyle"] if joined else "none"}
    square: Any = {"marker": "s", "linestyle": "none", "markersize": 5.0}
    first = [Line2D([], [], color=colour, label=name, **square) for name, colour in colours.items()]
    second = [Line2D([], [], color="#555555", label=name, markersize=MARKER, **how) for name, how in shapes.items()]
    if len(first) == 1 and second:
        for handle, (_, style) in zip(second, curves, strict=False):
            handle.set_color(style["color"])
        first = []
    return [*([first] if first else []), *(second[i : i + 2] for i in range(0, len(second), 2))]


def _draw_legend_rows(figure: Figure, rows: Sequence[list[Line2D]]) -> None:
    height_in = figure.get_figheight()
    for number, handles in enumerate(rows):
        figure.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=(0.12, 1.0 - number * _ROW_IN / height_in),
            ncols=len(handles),
            fontsize=PRINT,
            borderaxespad=0.1,
            handletextpad=0.4,
            columnspacing=1.2,
        )


def _ends(places: Sequence[float], margin: float) -> tuple[float, float]:
    width = 0.04 * (max(places) - min(places) or 1.0) + margin / 2.0
    return min(places) - width, max(places) + width


def _name_values(panel: Axes, experiment: Experiment, places: Mapping[str | float, float]) -> None:
    """Name the values of the horizontal axis."""
    if len(places) <= _MOST_TICKS:
        panel.set_xticks(list(places.values()), [_tick(value, experiment.x.factor) for value in places])
    else:
        panel.xaxis.set_major_locator(MaxNLocator(6))
        panel.xaxis.set_major_formatter(lambda value, _: _tick(value, experiment.x.factor))


def _name_never(panel: Axes, never_s: float) -> None:
    """Name the height of runs that never diverge."""
    panel.set_ylim(0.0, 1.12 * never_s)
    ticks = [tick for tick in MaxNLocator(4).tick_values(0.0, never_s) if tick < 0.85 * never_s]
    panel.set_yticks([*ticks, never_s], [*(f"{tick:g}" for tick in ticks), "never"])


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
        axes.set_ylim(max(min(means), _SHOWN * highest) / 1.5, max(top, 1.5 * highest))
        label_decades(axes.yaxis)
    else:
        axes.set_ylim(0.0, top or 1.0)


def _draw_divergence(
    axes: Axes, x: Sequence[float], points: Sequence[PointStatistics], style: dict[str, Any], never_s: float
) -> None:
    """Draw the mean time at which runs diverged and its range; a run that completes at the height of "never".

    Where some complete and some do not, both are drawn, with the number of the latter.
    """
    dots = {"color": style["color"], "marker": style["marker"], "markersize": MARKER, "linestyle": "none"}
    for at, m in zip(x, points, strict=True):
        if m.completed:
            axes.plot([at], [never_s], **dots)
        if m.diverged_s:
            mean_s = statistics.fmean(m.diverged_s)
            axes.plot([at], [mean_s], **dots | {"markerfacecolor": "white"})
            axes.plot([at, at], [min(m.diverged_s), max(m.diverged_s)], color=style["color"], linewidth=0.8)
            if m.completed:
                text, above = f"{len(m.diverged_s)} of {m.runs}", (0.0, 4.0)
                how: Any = {"textcoords": "offset points", "ha": "center", "fontsize": PRINT - 1.0}
                axes.annotate(text, (at, mean_s), above, color=style["color"], **how)


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
