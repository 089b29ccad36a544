"""Curve figure: time of divergence, cost and attitude over the varied quantity, with confidence intervals.

One column of a paper wide. A scenario has a colour, a curve of it (a distribution, a kind of loss) a marker and a line.
"""

import itertools
import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, NullLocator

from transport.experiments.declaration import NONE, Experiment, axis
from transport.experiments.statistics import COST_RATIO, PointStatistics
from transport.report.column import column_panels, draw_legend, head, legend_height_in
from transport.report.style import CURVES, DIVERGED, MARKER, REFERENCE, label_decades


class Panel(NamedTuple):
    """A panel: title, name of the number, factor."""

    title: str
    number: str
    factor: float = 1.0


class _Curve(NamedTuple):
    """A curve: its scenario, its name in the legend, its points and its style."""

    scenario: str
    name: str
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

# Distance between neighbouring curves, as a share of the axis, so that markers and error bars do not overlap; less
# where many values are near each other. All curves together take this share of the smallest distance of two values.
_APART, _APART_MANY, _TOGETHER = 0.035, 0.004, 0.7

# Height of a run that never diverges, over the time of the last divergence.
_NEVER = 1.25

# Limits of the upper end of the vertical axis over the highest mean; wide intervals, as of two runs, are cut off.
_HIGHEST, _LOWEST = 2.0, 1.12

# A mean this many times the median makes the axis logarithmic, unless the lowest is below this share of it. Ranges of
# more than this factor are labelled in powers of ten.
_OUTLIER, _SHOWN, _WIDE = 5.0, 1e-4, 200.0

# More values than this get round ticks instead of one each.
_MOST_TICKS = 10


def draw_curves(figure: Figure, experiment: Experiment, measured: Sequence[PointStatistics]) -> None:
    """Draw the panels: when runs diverge, if any does, and the numbers; each with the curves of all scenarios.

    Names and thresholds are in equal distances; growth with the team has logarithmic axes.
    """
    column, is_growth = experiment.x.label, experiment.drawn_as == "scaling"
    values = list(dict.fromkeys(m.point.labels[column] for m in measured))
    joined = not isinstance(values[0], str) and len(values) <= _MOST_TICKS  # no line between names or random times
    beside = [m for m in measured if not joined and _is_beside(m, column)]
    values = list(dict.fromkeys(m.point.labels[column] for m in measured if m not in beside)) or values
    is_number = is_growth or (isinstance(values[0], float) and experiment.drawn_as != "sharing")
    places = {value: float(value) if is_number else float(i) for i, value in enumerate(values)}
    curves = _styled_curves(experiment, measured, joined=joined)
    legend = _legend(curves, beside)
    diverged_s = [time_s for m in measured for time_s in m.diverged_s]
    never_s = _NEVER * max(diverged_s, default=0.0)
    shown = _PANELS[experiment.drawn_as]
    panels = column_panels(
        figure,
        [_PANEL_IN] * (len(shown) + bool(diverged_s)),
        x_label=experiment.x.title,
        top_in=legend_height_in(legend) + _ABOVE_IN,
    )
    draw_legend(figure, legend)
    above = panels.pop(0) if diverged_s else None
    apart = 0.0 if is_growth else _apart(list(places.values()), len(curves))
    for index, curve in enumerate(curves):
        points = [m for m in curve.points if m not in beside]
        shift = apart * (index - (len(curves) - 1) / 2.0)
        x = [places[m.point.labels[column]] + shift for m in points]
        if above is not None:
            _draw_divergence(above, x, points, curve.style, never_s)
        for panel, (_, number, factor) in zip(panels, shown, strict=True):
            _draw_means(panel, x, points, number, factor, curve.style)
            for m in beside:
                if m in curve.points and (value := m.mean(number)) is not None:
                    panel.axhline(factor * value, color=curve.style["color"], linewidth=0.8, linestyle="--")
    for panel, (title, number, factor) in zip(panels, shown, strict=True):
        head(panel, title, legend=False)
        means = [factor * value for curve in curves for m in curve.points if (value := m.mean(number)) is not None]
        if is_growth:
            _scale_growth(panel, means)
        elif number == COST_RATIO:
            panel.margins(y=0.12)
        else:
            _scale(panel, means)
    if above is not None:
        head(above, _DIVERGED, legend=False)
        _name_never(above, never_s)
    for panel in [*panels, *([above] if above is not None else [])]:
        panel.set_xlim(_ends(list(places.values()), apart * (len(curves) + 1)))
        _name_values(panel, places, experiment.x.factor)


def _apart(places: Sequence[float], curves: int) -> float:
    """Return the distance between neighbouring curves, in units of the horizontal axis."""
    span = max(places) - min(places) or 1.0
    if len(places) > _MOST_TICKS:
        return _APART_MANY * span
    gap = min((high - low for low, high in itertools.pairwise(sorted(places))), default=span)
    return min(_APART * span, _TOGETHER * gap / curves)


def _is_beside(m: PointStatistics, column: str) -> bool:
    """Return whether the axis does not apply to a point, such as a run without a kill to the time of the kill."""
    return not isinstance(m.point.labels[column], str) and NONE in m.point.labels.values()


def _styled_curves(experiment: Experiment, measured: Sequence[PointStatistics], *, joined: bool) -> list[_Curve]:
    """Return each curve of each scenario."""
    scenarios = list(dict.fromkeys(m.point.scenario for m in measured))
    found = []
    for place, scenario in enumerate(scenarios):
        own = _curves(experiment, [m for m in measured if m.point.scenario == scenario])
        for index, (name, points) in enumerate(own.items()):
            shape = index if experiment.curves is not None else place
            colour = shape if len(scenarios) == 1 else place  # with one scenario, curves have colours of their own
            _, marker, line = CURVES[(shape + shape // len(CURVES)) % len(CURVES)]
            shown = CURVES[colour % len(CURVES)][0]
            style = {"color": shown, "marker": marker, "linestyle": line if joined else "none"}
            found.append(_Curve(scenario, name, points, style))
    return found


def _curves(experiment: Experiment, measured: Sequence[PointStatistics]) -> dict[str, list[PointStatistics]]:
    """Return the points of each curve by its name in the legend, in the order of the horizontal axis."""
    column = experiment.curves
    if column is None:
        return {measured[0].point.scenario: list(measured)}
    curves = {}
    for value in dict.fromkeys(m.point.labels[column] for m in measured):
        if value != NONE:
            # The last of several points at one x belongs to the curve: the constant delay, not the perfect network.
            own = {m.point.labels[experiment.x.label]: m for m in measured if m.point.labels[column] in (NONE, value)}
            text = value if isinstance(value, str) else axis(column).text(value)
            curves[experiment.legend.get(value, text)] = list(own.values())
    return curves


def _legend(curves: Sequence[_Curve], beside: Sequence[PointStatistics]) -> dict[str, list[Line2D]]:
    """Return the handles of the curves: a row for each scenario with several, else one for all."""
    rows: dict[str, list[Line2D]] = {}
    for curve in curves:
        title = "" if curve.name == curve.scenario else curve.scenario
        rows.setdefault(title, []).append(Line2D([], [], label=curve.name, markersize=MARKER, **curve.style))
    if beside:
        colour = curves[0].style["color"] if len(curves) == 1 else REFERENCE
        line = Line2D([], [], label=beside[0].point.text, color=colour, linewidth=0.8, linestyle="--")
        next(iter(rows.values())).append(line)
    return rows


def _ends(places: Sequence[float], margin: float) -> tuple[float, float]:
    width = 0.04 * (max(places) - min(places) or 1.0) + margin / 2.0
    return min(places) - width, max(places) + width


def _name_values(panel: Axes, places: Mapping[str | float, float], factor: float) -> None:
    """Name the values of the horizontal axis."""

    def text(value: str | float) -> str:
        return value if isinstance(value, str) else f"{factor * value:g}"

    if len(places) <= _MOST_TICKS:
        panel.set_xticks(list(places.values()), [text(value) for value in places])
    else:
        panel.xaxis.set_major_locator(MaxNLocator(6))
        panel.xaxis.set_major_formatter(lambda value, _: text(value))


def _name_never(panel: Axes, never_s: float) -> None:
    """Name the height of runs that never diverge."""
    panel.set_ylim(0.0, 1.12 * never_s)
    ticks = [tick for tick in MaxNLocator(4).tick_values(0.0, never_s) if tick < 0.85 * never_s]
    panel.set_yticks([*ticks, never_s], [*(f"{tick:g}" for tick in ticks), "never"])


def _scale(axes: Axes, means: Sequence[float]) -> None:
    """Fit the vertical axis to the means; logarithmic if a few nearly diverged runs are far above the rest."""
    lowest, highest = min(means, default=0.0), max(means, default=0.0)
    top = min(max(axes.get_ylim()[1], _LOWEST * highest), _HIGHEST * highest)
    if highest > _OUTLIER * statistics.median(means or [0.0]) and lowest > _SHOWN * highest:
        axes.set_yscale("log")
        axes.set_ylim(lowest / 1.5, max(top, 1.5 * highest))
        if highest < _WIDE * lowest:
            label_decades(axes.yaxis)
    else:
        axes.set_ylim(0.0, top or 1.0)


def _scale_growth(axes: Axes, means: Sequence[float]) -> None:
    """Make both axes logarithmic and fit the vertical one to the means: a power of N is a straight line."""
    positive = [mean for mean in means if mean > 0.0]
    axes.set_xscale("log")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_yscale("log")
    if positive:
        axes.set_ylim(min(positive) / 1.4, max(positive) * 1.4)
    label_decades(axes.yaxis)


def _draw_divergence(
    axes: Axes, x: Sequence[float], points: Sequence[PointStatistics], style: dict[str, Any], never_s: float
) -> None:
    """Draw the mean time at which runs diverged and its range; a run that completes at the height of "never"."""
    dots = {"color": style["color"], "marker": style["marker"], "markersize": MARKER, "linestyle": "none"}
    for at, m in zip(x, points, strict=True):
        if m.completed:
            axes.plot([at], [never_s], **dots)
        if m.diverged_s:
            axes.plot([at, at], [min(m.diverged_s), max(m.diverged_s)], color=style["color"], linewidth=0.8)
            axes.plot([at], [statistics.fmean(m.diverged_s)], **dots | DIVERGED)


def _draw_means(
    axes: Axes, x: Sequence[float], points: Sequence[PointStatistics], number: str, factor: float, style: dict[str, Any]
) -> None:
    """Draw means over the completed runs, with confidence intervals; a gap where no run was completed."""
    means, halves = [], []
    for m in points:
        mean, value = m.mean(number), m.numbers.get(number)
        means.append(math.nan if mean is None else factor * mean)
        halves.append(0.0 if value is None or value.half_width is None else factor * value.half_width)
    axes.plot(x, means, **{"markersize": MARKER, **style})
    axes.errorbar(x, means, halves, color=style["color"], linestyle="none", capsize=1.5, elinewidth=0.8)
