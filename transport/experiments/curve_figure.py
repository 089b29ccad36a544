"""Curve figure: time of divergence, cost and attitude over the varied quantity, with confidence intervals.

One column of a paper wide. A scenario has a colour, a curve of it (a distribution, a kind of loss) a marker and a line.
"""

import itertools
import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, NullLocator

from transport.experiments.declaration import NONE, Experiment, axis
from transport.experiments.statistics import COST_RATIO, PointStatistics
from transport.report.column import column_panels, head
from transport.report.style import CURVES, DIVERGED, MARKER, label_decades


class Panel(NamedTuple):
    """A panel: title, name of the number, factor."""

    title: str
    number: str
    factor: float = 1.0


class _Curve(NamedTuple):
    """A curve: its points in the order of the horizontal axis, and its style with its name."""

    points: list[PointStatistics]
    style: dict[str, Any]


_ATTITUDE = Panel("largest payload attitude (deg)", "attitude_max_deg")
# Panels by how an experiment is drawn.
_PANELS: Mapping[str, Sequence[Panel]] = {
    "curves": (Panel("mean cost of completed runs ($10^{-3}$)", "cost_mean", 1e3), _ATTITUDE),
    "sharing": (
        Panel("plans sent (%)", "plans_shared_share", 100.0),
        Panel("mean cost over that with all plans sent", COST_RATIO),
        _ATTITUDE,
    ),
    "tracking": (
        Panel("payload error, root mean square (cm)", "payload_rms_m", 100.0),
        Panel("largest payload error (cm)", "payload_max_m", 100.0),
        _ATTITUDE,
    ),
    "scaling": (
        Panel("agent's CPU per step (ms)", "cpu_step_p50_ms"),
        Panel("team's CPU per tick (ms)", "cpu_team_tick_ms"),
        Panel("plans sent (kB/s)", "plan_bytes_per_s", 1e-3),
        Panel("mean cost ($10^{-3}$)", "cost_mean", 1e3),
    ),
}
_DIVERGED = "time at which runs diverge (s, hollow), or never"

# Height of a panel, and of the title of the first, in.
_PANEL_IN, _ABOVE_IN = 0.95, 0.17

# Distance between neighbouring curves, as a share of the axis, so that markers and error bars do not overlap; all
# curves together take at most this share of the smallest distance of two values.
_APART, _TOGETHER = 0.035, 0.7

# Height of a run that never diverges, over the time of the last divergence.
_NEVER = 1.25

# Limits of the upper end of the vertical axis over the highest mean; wide intervals, as of two runs, are cut off.
_HIGHEST, _LOWEST = 2.0, 1.12

# A mean this many times the median makes the axis logarithmic, unless the lowest is below this share of it.
_OUTLIER, _SHOWN = 5.0, 1e-3

# More values than this get round ticks instead of one each.
_MOST_TICKS = 10


def draw_curves(figure: Figure, experiment: Experiment, measured: Sequence[PointStatistics]) -> None:
    """Draw the panels: when runs diverge, if any does, and the numbers; each with the curves of all scenarios.

    Names and thresholds are in equal distances; growth with the team has logarithmic axes.
    """
    column, is_growth = experiment.x.label, experiment.drawn_as == "scaling"
    values = list(dict.fromkeys(m.point.labels[column] for m in measured))
    joined = not isinstance(values[0], str) and len(values) <= _MOST_TICKS  # no line between names or random times
    is_number = is_growth or (isinstance(values[0], float) and experiment.drawn_as != "sharing")
    places = {value: float(value) if is_number else float(i) for i, value in enumerate(values)}
    curves = list(_curves(experiment, measured, joined=joined))
    diverged_s = [time_s for m in measured for time_s in m.diverged_s]
    shown = _PANELS[experiment.drawn_as]
    panels = column_panels(
        figure,
        [_PANEL_IN] * (len(shown) + bool(diverged_s)),
        legend=[Line2D([], [], **curve.style) for curve in curves],
        x_label=experiment.x.title,
        top_in=_ABOVE_IN,
    )
    span = max(places.values()) - min(places.values()) or 1.0
    gap = min((high - low for low, high in itertools.pairwise(sorted(places.values()))), default=span)
    apart = 0.0 if is_growth else min(_APART * span, _TOGETHER * gap / len(curves))
    xs = [
        [places[m.point.labels[column]] + apart * (index - (len(curves) - 1) / 2.0) for m in curve.points]
        for index, curve in enumerate(curves)
    ]
    for panel in panels:
        margin = 0.04 * span + apart * (len(curves) + 1) / 2.0
        panel.set_xlim(min(places.values()) - margin, max(places.values()) + margin)
        if is_growth:
            panel.set_xscale("log")
            panel.xaxis.set_minor_locator(NullLocator())
        _name_values(panel, places, experiment.x.factor)
    if diverged_s:
        _draw_divergence(panels.pop(0), curves, xs, _NEVER * max(diverged_s))
    for panel, (title, number, factor) in zip(panels, shown, strict=True):
        head(panel, title, legend=False)
        means = [
            factor * mean
            for x, curve in zip(xs, curves, strict=True)
            for mean in _draw_means(panel, x, curve, number, factor)
        ]
        _scale(panel, means, is_ratio=number == COST_RATIO, is_growth=is_growth)


def _curves(experiment: Experiment, measured: Sequence[PointStatistics], *, joined: bool) -> Iterator[_Curve]:
    """Yield each curve of each scenario; points labelled `NONE` belong to all curves of their scenario."""
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    column = experiment.curves
    for place, scenario in enumerate(scenarios):
        found = [m for m in measured if m.point.scenario == scenario]
        values = dict.fromkeys(m.point.labels[column] if column else "" for m in found)
        for index, value in enumerate(value for value in values if value != NONE):
            # The last of several points at one x belongs to the curve: the constant delay, not the perfect network.
            own = {
                m.point.labels[experiment.x.label]: m
                for m in found
                if column is None or m.point.labels[column] in (NONE, value)
            }
            text = value if isinstance(value, str) or column is None else axis(column).text(value)
            name = experiment.legend.get(value, text)
            label = scenario if column is None else name if len(scenarios) == 1 else f"{scenario}, {name}"
            shape = index if column else place
            colour = shape if len(scenarios) == 1 else place  # with one scenario, curves have colours of their own
            _, marker, line = CURVES[(shape + shape // len(CURVES)) % len(CURVES)]
            style = {"color": CURVES[colour % len(CURVES)][0], "marker": marker, "linestyle": line if joined else ""}
            yield _Curve(list(own.values()), {**style, "markersize": MARKER, "label": label})


def _name_values(panel: Axes, places: Mapping[str | float, float], factor: float) -> None:
    """Name the values of the horizontal axis."""

    def text(value: str | float) -> str:
        return value if isinstance(value, str) else f"{factor * value:g}"

    if len(places) <= _MOST_TICKS:
        panel.set_xticks(list(places.values()), [text(value) for value in places])
    else:
        panel.xaxis.set_major_locator(MaxNLocator(6))
        panel.xaxis.set_major_formatter(lambda value, _: text(value))


def _scale(axes: Axes, means: Sequence[float], *, is_ratio: bool, is_growth: bool) -> None:
    """Fit the vertical axis to the means; logarithmic for growth, or if nearly diverged runs are far above the rest."""
    lowest, highest = min(means, default=0.0), max(means, default=0.0)
    top = min(max(axes.get_ylim()[1], _LOWEST * highest), _HIGHEST * highest)
    outlier = highest > _OUTLIER * statistics.median(means or [0.0]) and lowest > _SHOWN * highest
    if is_ratio:
        axes.margins(y=0.12)
    elif lowest > 0.0 and (is_growth or outlier):
        axes.set_yscale("log")
        axes.set_ylim(lowest / 1.4, 1.4 * highest)
        label_decades(axes.yaxis)
    else:
        axes.set_ylim(0.0, top or 1.0)


def _draw_divergence(axes: Axes, curves: Sequence[_Curve], xs: Sequence[Sequence[float]], never_s: float) -> None:
    """Draw the mean time at which runs diverged and its range; a run that completes at the height of "never"."""
    for x, (points, style) in zip(xs, curves, strict=True):
        dots = style | {"linestyle": "none"}
        for at, m in zip(x, points, strict=True):
            if m.completed:
                axes.plot([at], [never_s], **dots)
            if m.diverged_s:
                axes.plot([at, at], [m.diverged_s[0], m.diverged_s[-1]], color=style["color"], linewidth=0.8)
                axes.plot([at], [statistics.fmean(m.diverged_s)], **dots | DIVERGED)
    head(axes, _DIVERGED, legend=False)
    axes.set_ylim(0.0, 1.12 * never_s)
    ticks = [tick for tick in MaxNLocator(4).tick_values(0.0, never_s) if tick < 0.85 * never_s]
    axes.set_yticks([*ticks, never_s], [*(f"{tick:g}" for tick in ticks), "never"])


def _draw_means(axes: Axes, x: Sequence[float], curve: _Curve, number: str, factor: float) -> list[float]:
    """Draw the means over completed runs, with confidence intervals; return them."""
    found = [(m.mean(number), m.numbers.get(number)) for m in curve.points]
    means = [math.nan if mean is None else factor * mean for mean, _ in found]
    halves = [factor * ((value.half_width if value else None) or 0.0) for _, value in found]
    axes.plot(x, means, **curve.style)
    axes.errorbar(x, means, halves, color=curve.style["color"], linestyle="none", capsize=1.5, elinewidth=0.8)
    return [mean for mean, _ in found if mean is not None]
