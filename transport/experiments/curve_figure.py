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
from matplotlib.ticker import MaxNLocator

from transport.experiments.declaration import NONE, Experiment
from transport.experiments.statistics import PointStatistics
from transport.report.column import column_panels, draw_legend, head, legend_height_in
from transport.report.style import CURVES, DIVERGED, MARKER, REFERENCE, SMALL, label_decades


class Panel(NamedTuple):
    """A panel: title, name of the number or `COST_RATIO`, factor, whether the axis begins at zero."""

    title: str
    number: str
    factor: float = 1.0
    from_zero: bool = True


class _Curve(NamedTuple):
    """A curve: its scenario, its name in the legend, its points and its style."""

    scenario: str
    name: str
    points: list[PointStatistics]
    style: dict[str, Any]


COST_RATIO = "cost_ratio"
_ATTITUDE = Panel("largest payload attitude (deg)", "attitude_max_deg")
_PANELS = (Panel("mean cost of completed runs ($10^{-3}$)", "cost_mean", 1e3), _ATTITUDE)
_SHARING_PANELS = (
    Panel("plans sent (%)", "plans_shared_share", 100.0),
    Panel("mean cost over that with all plans sent", COST_RATIO, from_zero=False),
    _ATTITUDE,
)
_TRACKING_PANELS = (
    Panel("payload error, root mean square (cm)", "payload_rms_m", 100.0),
    Panel("largest payload error (cm)", "payload_max_m", 100.0),
    _ATTITUDE,
)
_DIVERGED = "time at which runs diverge (s, hollow), or never"

# Height of a panel, and of the title of the first, in.
_PANEL_IN, _ABOVE_IN = 0.95, 0.17

# Distance between neighbouring curves, as a share of the axis, so that markers and error bars do not overlap; less
# where many values are near each other. All curves together take this share of the smallest distance of two values.
_APART, _APART_MANY, _TOGETHER = 0.035, 0.004, 0.7

# Height of a run that never diverges, over the time of the last divergence.
_NEVER = 1.25
# Share of it from which on the number of diverged runs stands below the marker; height of a line, in font sizes.
_MIDDLE, _LINE = 0.4, 0.9

# Limits of the upper end of the vertical axis over the highest mean; wide intervals, as of two runs, are cut off.
_HIGHEST, _LOWEST = 2.0, 1.12

# A mean this many times the median makes the axis logarithmic, unless the lowest is below this share of it. Ranges of
# more than this factor are labelled in powers of ten.
_OUTLIER, _SHOWN, _WIDE = 5.0, 1e-4, 200.0

# More values than this get round ticks instead of one each.
_MOST_TICKS = 10


def draw_curves(figure: Figure, experiment: Experiment, measured: Sequence[PointStatistics]) -> None:
    """Draw the panels: when runs diverge, if any does, cost and attitude; each with the curves of all scenarios.

    Of shared plans: plans sent, cost over that with all sent, and attitude over the threshold, in equal distances.
    """
    is_sharing = experiment.drawn_as == "sharing"
    shown = {"sharing": _SHARING_PANELS, "tracking": _TRACKING_PANELS}.get(experiment.drawn_as, _PANELS)
    column = experiment.x.label
    values = list(dict.fromkeys(m.point.labels[column] for m in measured))
    joined = not isinstance(values[0], str) and len(values) <= _MOST_TICKS  # no line between names or random times
    apart_from_axis = [m for m in measured if not joined and _is_beside(m, column)]
    values = list(dict.fromkeys(m.point.labels[column] for m in measured if m not in apart_from_axis)) or values
    places = {v: v if isinstance(v, float) and not is_sharing else float(i) for i, v in enumerate(values)}
    curves = _styled_curves(experiment, measured, joined=joined)
    rows = _legend(curves, apart_from_axis)
    diverged_s = [time_s for m in measured for time_s in m.diverged_s]
    first = bool(diverged_s)
    panels = column_panels(
        figure,
        [_PANEL_IN] * (len(shown) + first),
        x_label=experiment.x.title,
        top_in=legend_height_in(rows) + _ABOVE_IN,
    )
    draw_legend(figure, rows)
    apart = _apart(list(places.values()), len(curves))
    ends = _ends(list(places.values()), apart * (len(curves) + 1))
    # Numbers of diverged runs stand upright beside one another.
    distance_pt = 72.0 * apart / (ends[1] - ends[0]) * panels[0].get_position().width * figure.get_figwidth()
    counted = len(values) <= _MOST_TICKS and (len(curves) == 1 or distance_pt > _LINE * SMALL)
    for index, curve in enumerate(curves):
        points = [m for m in curve.points if m not in apart_from_axis]
        shift = apart * (index - (len(curves) - 1) / 2.0)
        x = [places[m.point.labels[column]] + shift for m in points]
        if diverged_s:
            _draw_divergence(panels[0], x, points, curve.style, _NEVER * max(diverged_s), counted=counted)
        for panel, (_, number, factor, _) in zip(panels[first:], shown, strict=True):
            draw_means(panel, x, points, number, factor, curve.style)
            for m in apart_from_axis:
                if m in curve.points and (value := _mean(m, number)) is not None:
                    panel.axhline(factor * value, color=curve.style["color"], linewidth=0.8, linestyle="--")
    for panel in panels:
        panel.set_xlim(ends)
        _name_values(panel, experiment, places)
    drawn = [m for curve in curves for m in curve.points]
    for panel, (title, number, factor, from_zero) in zip(panels[first:], shown, strict=True):
        head(panel, title, legend=False)
        means = [factor * value for m in drawn if (value := _mean(m, number)) is not None]
        if from_zero:
            _scale(panel, means)
        else:
            panel.margins(y=0.12)
    if diverged_s:
        head(panels[0], _DIVERGED, legend=False)
        _name_never(panels[0], _NEVER * max(diverged_s))


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


def _legend(curves: Sequence[_Curve], beside: Sequence[PointStatistics]) -> dict[str, list[Line2D]]:
    """Return the handles of the curves: a row for each scenario with several, else one for all."""
    rows: dict[str, list[Line2D]] = {}
    for curve in curves:
        title = "" if curve.name == curve.scenario else curve.scenario
        rows.setdefault(title, []).append(Line2D([], [], label=curve.name, markersize=MARKER, **curve.style))
    if beside:
        colour = curves[0].style["color"] if len(curves) == 1 else REFERENCE
        line = Line2D([], [], label=beside[0].point.text, color=colour, linewidth=0.8, linestyle="--")
        rows[next(iter(rows))].append(line)
    return rows


def _curves(experiment: Experiment, measured: Sequence[PointStatistics]) -> dict[str, list[PointStatistics]]:
    """Return the points of each curve by its name in the legend, in the order of the horizontal axis."""
    column = experiment.curves
    if column is None:
        return {measured[0].point.scenario: list(measured)}
    values = dict.fromkeys(m.point.labels[column] for m in measured)
    curves = {}
    for value in (value for value in values if value != NONE):
        # The last of several points at one x belongs to the curve: the constant delay, not the perfect network.
        own = {m.point.labels[experiment.x.label]: m for m in measured if m.point.labels[column] in (NONE, value)}
        curves[experiment.legend.get(value, str(value))] = list(own.values())
    return curves


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


def _draw_divergence(
    axes: Axes,
    x: Sequence[float],
    points: Sequence[PointStatistics],
    style: dict[str, Any],
    never_s: float,
    *,
    counted: bool,
) -> None:
    """Draw the mean time at which runs diverged and its range; a run that completes at the height of "never".

    Where some complete and some do not, both are drawn, if `counted` with the number of the latter.
    """
    dots = {"color": style["color"], "marker": style["marker"], "markersize": MARKER, "linestyle": "none"}
    for at, m in zip(x, points, strict=True):
        if m.completed:
            axes.plot([at], [never_s], **dots)
        if m.diverged_s:
            mean_s = statistics.fmean(m.diverged_s)
            axes.plot([at, at], [min(m.diverged_s), max(m.diverged_s)], color=style["color"], linewidth=0.8)
            axes.plot([at], [mean_s], **dots | DIVERGED)
            if m.completed and counted:
                below = mean_s > _MIDDLE * never_s
                how: Any = {"textcoords": "offset points", "ha": "center", "va": "top" if below else "bottom"}
                how |= {"rotation": 90, "color": style["color"], "fontsize": SMALL}
                axes.annotate(f"{len(m.diverged_s)} of {m.runs}", (at, mean_s), (0.0, -3.5 if below else 3.5), **how)


def draw_means(
    axes: Axes, x: Sequence[float], points: Sequence[PointStatistics], number: str, factor: float, style: dict[str, Any]
) -> list[float]:
    """Draw and return means over the completed runs, with confidence intervals; nan where no run was completed."""
    means, halves = [], []
    for m in points:
        mean, value = _mean(m, number), m.numbers.get(number)
        means.append(math.nan if mean is None else factor * mean)
        halves.append(0.0 if value is None or value.half_width is None else factor * value.half_width)
    axes.plot(x, means, **{"markersize": MARKER, **style})
    axes.errorbar(x, means, halves, color=style["color"], linestyle="none", capsize=1.5, elinewidth=0.8)
    return means


def _mean(m: PointStatistics, number: str) -> float | None:
    """Return the mean of a number over the completed runs; None where no run was completed."""
    if number == COST_RATIO:
        return m.cost_ratio
    value = m.numbers[number]
    return None if value is None else value.mean


def _tick(value: str | float, factor: float) -> str:
    return value if isinstance(value, str) else f"{factor * value:g}"
