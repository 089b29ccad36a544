"""Curves over one quantity: the time of divergence, and means with their confidence intervals.

A scenario has a colour, a curve of it (a distribution, a kind of loss) a marker and a line.
"""

import itertools
import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, NullLocator

from transport.experiments.declaration import NONE, Axis, Experiment, axis
from transport.experiments.figures.figure_parts import mark_style, values_of
from transport.experiments.statistics import COST_RATIO, PointStatistics
from transport.report.figures.column import Room, column_panels, head
from transport.report.figures.style import DIVERGED, label_decades, styles_of

Scenarios = Mapping[str, Sequence[PointStatistics]]

# Height of a panel, of one whose curves are flat, and room above them, inches.
_PANEL_IN = 0.95
_FLAT_PANEL_IN = 0.5
_ABOVE_IN = 0.2
# More values than this get round ticks instead of one each, and no line between them.
_MOST_TICKS = 10
# Distance between neighbouring curves, as shares of the axis and of the distance between values,
# and room at both ends of the axis.
_APART_OF_SPAN = 0.035
_APART_OF_GAP = 0.7
_ROOM = 0.04
# Height of "never" over the latest divergence, and highest tick below it.
_NEVER = 1.25
_HIGHEST_TICK = 0.85
# A curve is flat if its means are within this share of the largest.
_FLAT = 0.01
# Means that far above their median are nearly diverged runs: the axis becomes logarithmic.
_FAR_ABOVE = 5.0
# Ends of a vertical axis: of one from zero over its highest mean, so that the marker is within it; the most
# of it that error bars can ask for, beyond which they leave the panel; of a logarithmic one over its highest
# mean, and below its lowest by the same factor; of ratios, about which zero tells nothing, as a share of the data.
_ABOVE_HIGHEST = 1.12
_MOST_FOR_BARS = 2.0
_BEYOND_DECADES = 1.4
_ABOUT_RATIOS = 0.12


class FigurePanel(NamedTuple):
    """A panel: its title, the name of its number, and the factor to its unit."""

    title: str
    number: str
    factor: float = 1.0


class _Curve(NamedTuple):
    """A curve: its points in the order of the horizontal axis, and its style with its name."""

    points: list[PointStatistics]
    style: dict[str, Any]


_ATTITUDE = FigurePanel("largest payload attitude (deg)", "attitude_max_deg")
# Panels by how an experiment is drawn.
_PANELS: Mapping[str, Sequence[FigurePanel]] = {
    "curves": (FigurePanel("mean cost of completed runs ($10^{-3}$)", "cost_mean", 1e3), _ATTITUDE),
    "sharing": (
        FigurePanel("plans sent (%)", "plans_shared_share", 100.0),
        FigurePanel("mean cost over that with all plans sent", COST_RATIO),
        _ATTITUDE,
    ),
    "radio": (
        FigurePanel("plans delivered by the radio (%)", "air_delivered_share", 100.0),
        FigurePanel("airtime (%)", "airtime_share", 100.0),
        FigurePanel("payload error, root mean square (cm)", "payload_rms_m", 100.0),
        FigurePanel("mean cost over that without a radio", COST_RATIO),
    ),
    "scaling": (
        FigurePanel("agent's CPU per step (ms)", "cpu_step_p50_ms"),
        FigurePanel("team's CPU per tick (ms)", "cpu_team_tick_ms"),
        FigurePanel("plans sent (kB/s)", "plan_bytes_per_s", 1e-3),
        FigurePanel("mean cost ($10^{-3}$)", "cost_mean", 1e3),
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Abscissa:
    """The horizontal axis of an experiment.

    Attributes:
        axis: Its column, title and unit.
        values: Values of the points, in their order.
        is_number: Whether values stand at their numbers; names and thresholds have equal distances.
        is_growth: Whether the axis is logarithmic.
    """

    axis: Axis
    values: Sequence[float | str]
    is_number: bool
    is_growth: bool

    @classmethod
    def of(cls, experiment: Experiment, scenarios: Scenarios) -> "_Abscissa":
        """Return the axis of all points of an experiment."""
        x = axis(experiment.x)
        values = values_of((one for own in scenarios.values() for one in own), x.label)
        is_growth = experiment.drawn_as == "scaling"
        is_threshold = experiment.drawn_as == "sharing"
        is_number = is_growth or (isinstance(values[0], int | float) and not is_threshold)
        return cls(axis=x, values=values, is_number=is_number, is_growth=is_growth)

    @property
    def is_few(self) -> bool:
        """True if every value has a tick."""
        return len(self.values) <= _MOST_TICKS

    @property
    def is_joined(self) -> bool:
        """True if the points of a curve are joined by a line."""
        return self.is_few and not isinstance(self.values[0], str)

    @property
    def places(self) -> dict[float | str, float]:
        """Place of each value on the axis."""
        if self.is_number:
            return {value: self.axis.factor * float(value) for value in self.values}
        return {value: float(i) for i, value in enumerate(self.values)}

    @property
    def span(self) -> float:
        """Length of the axis between its first and last value, 1 for a single one."""
        places = self.places.values()
        return max(places) - min(places) or 1.0

    def apart(self, curves: int) -> float:
        """Return the distance between curves that keeps markers and error bars apart.

        Only names leave room for it: on an axis of numbers a marker stands on its value.
        """
        if self.is_number:
            return 0.0
        pairs = itertools.pairwise(sorted(self.places.values()))
        gap = min((high - low for low, high in pairs), default=self.span)
        return min(_APART_OF_SPAN * self.span, _APART_OF_GAP * gap / curves)

    def places_of(self, curves: Sequence[_Curve]) -> list[list[float]]:
        """Return the places of the points of each curve."""
        apart = self.apart(len(curves))
        middle = (len(curves) - 1) / 2.0
        places = self.places
        return [
            [places[one.point.labels[self.axis.label]] + apart * (i - middle) for one in points]
            for i, (points, _) in enumerate(curves)
        ]

    def apply(self, panel: Axes, curves: int) -> None:
        """Set limits, scale and ticks of a panel."""
        places = self.places
        margin = _ROOM * self.span + self.apart(curves) * (curves + 1) / 2.0
        panel.set_xlim(min(places.values()) - margin, max(places.values()) + margin)

        if self.is_growth:
            panel.set_xscale("log")
            panel.xaxis.set_minor_locator(NullLocator())

        if self.is_few or not self.is_number:
            names = [
                value if isinstance(value, str) else f"{self.axis.factor * value:g}"
                for value in self.values
            ]
            panel.set_xticks(list(places.values()), names)


def draw_curves(figure: Figure, experiment: Experiment, scenarios: Scenarios) -> None:
    """Draw the panels of an experiment, each with the curves of all scenarios.

    The first panel has the times of divergence, if any run diverges.
    """
    x = _Abscissa.of(experiment, scenarios)
    curves = list(_curves(experiment, scenarios, joined=x.is_joined))
    places = x.places_of(curves)
    measured = [one for own in scenarios.values() for one in own]
    diverged_s = [time_s for one in measured for time_s in one.diverged_s]

    shown = _PANELS[experiment.drawn_as]
    heights_in = [_FLAT_PANEL_IN if _is_flat(one, curves) else _PANEL_IN for one in shown]
    panels = column_panels(
        figure,
        [*([_PANEL_IN] if diverged_s else []), *heights_in],
        legend=[Line2D([], [], **curve.style) for curve in curves],
        x_label=x.axis.title,
        room=Room(top_in=_ABOVE_IN),
    )
    for panel in panels:
        x.apply(panel, len(curves))

    if diverged_s:
        _draw_divergence(panels.pop(0), curves, places, _NEVER * max(diverged_s))
    for panel, content in zip(panels, shown, strict=True):
        head(panel, content.title, legend=False)
        means = _draw_means(panel, content, curves, places)
        is_ratio = content.number == COST_RATIO
        _scale(panel, means or [0.0], is_ratio=is_ratio, is_growth=x.is_growth)


def _is_flat(content: FigurePanel, curves: Sequence[_Curve]) -> bool:
    """Return whether no curve of a panel changes along the axis."""
    for curve in curves:
        values = [one.mean(content.number) for one in curve.points]
        means = [mean for mean in values if mean is not None]
        if means and max(means) - min(means) > _FLAT * max(map(abs, means)):
            return False
    return True


def _draw_means(
    panel: Axes,
    content: FigurePanel,
    curves: Sequence[_Curve],
    places: Sequence[Sequence[float]],
) -> list[float]:
    """Draw a number of every curve with its confidence intervals; return all means."""
    drawn: list[float] = []
    for curve_places, curve in zip(places, curves, strict=True):
        means = [one.mean(content.number) for one in curve.points]
        heights = [math.nan if mean is None else content.factor * mean for mean in means]
        bars = content.factor * np.array([one.bar(content.number) for one in curve.points]).T
        panel.errorbar(curve_places, heights, bars, capsize=1.5, elinewidth=0.8, **curve.style)
        drawn += [height for height in heights if not math.isnan(height)]
    return drawn


def _curves(experiment: Experiment, scenarios: Scenarios, *, joined: bool) -> Iterator[_Curve]:
    """Yield each curve of each scenario.

    A scenario has a colour, a value in the column of the curves a marker and a line; with a single scenario
    each value has a colour of its own. Points labelled `NONE` belong to all curves of their scenario.
    """
    column = experiment.curves
    is_single = len(scenarios) == 1
    for scenario, look in styles_of(list(scenarios)).items():
        measured = scenarios[scenario]
        if column is None:
            points = _points(experiment, measured, None)
            yield _Curve(points, {**_style(look, joined=joined), "label": scenario})
            continue

        named = {
            _name(experiment, column, value): value
            for value in values_of(measured, column)
            if value != NONE
        }
        for name, (own_colour, marker, line) in styles_of(list(named)).items():
            points = _points(experiment, measured, named[name])
            colour = own_colour if is_single else look[0]
            label = name if is_single else f"{scenario}, {name}"
            style = _style((colour, marker, line), joined=joined)
            yield _Curve(points, {**style, "label": label})


def _points(
    experiment: Experiment, measured: Sequence[PointStatistics], value: float | str | None
) -> list[PointStatistics]:
    """Return the points of the curve with a value in the column of the curves.

    Points at one x follow each other in `measured`, and the last of them belongs to the curve: the constant
    delay, not the perfect network.
    """
    column = experiment.curves
    return list(
        {
            one.point.labels[experiment.x]: one
            for one in measured
            if column is None or one.point.labels[column] in (NONE, value)
        }.values()
    )


def _name(experiment: Experiment, column: str, value: float | str) -> str:
    """Return the name of a curve with a value in a column."""
    text = value if isinstance(value, str) else axis(column).text(value)
    return experiment.legend.get(value, text)


def _style(look: tuple[str, str, str], *, joined: bool) -> dict[str, Any]:
    """Return the style of a curve with a colour, marker and line."""
    return mark_style(look, look[2] if joined else "")


def _scale(axes: Axes, means: Sequence[float], *, is_ratio: bool, is_growth: bool) -> None:
    """Fit the vertical axis to the means that are drawn, and to their error bars as far as they leave these readable.

    It is logarithmic for growth, and if few means are far above the rest; about the data for ratios; else it
    begins at zero.
    """
    lowest = min(means)
    highest = max(means)
    if is_ratio:
        axes.margins(y=_ABOUT_RATIOS)
    elif lowest > 0.0 and (is_growth or highest > _FAR_ABOVE * statistics.median(means)):
        axes.set_yscale("log")
        axes.set_ylim(lowest / _BEYOND_DECADES, _BEYOND_DECADES * highest)
        label_decades(axes.yaxis)
    elif highest > 0.0:
        with_bars = axes.get_ylim()[1]  # of matplotlib, with its own margin
        top = max(with_bars, _ABOVE_HIGHEST * highest)
        axes.set_ylim(0.0, min(top, _MOST_FOR_BARS * highest))
    else:
        axes.set_ylim(0.0, 1.0)  # all are zero


def _draw_divergence(
    axes: Axes,
    curves: Sequence[_Curve],
    places: Sequence[Sequence[float]],
    never_s: float,
) -> None:
    """Draw the mean time at which runs diverged and its range.

    Points with completed runs have a mark at the height of "never", too.
    """
    for curve_places, (points, style) in zip(places, curves, strict=True):
        dots = style | {"linestyle": "none"}
        for place, one in zip(curve_places, points, strict=True):
            if one.completed:
                axes.plot([place], [never_s], **dots)
            if one.diverged_s:
                ends_s = [one.diverged_s[0], one.diverged_s[-1]]
                axes.plot([place, place], ends_s, color=style["color"], linewidth=0.8)
                axes.plot([place], [statistics.fmean(one.diverged_s)], **dots | DIVERGED)

    head(axes, "time at which runs diverge (s, hollow), or never", legend=False)
    axes.set_ylim(0.0, _ABOVE_HIGHEST * never_s)
    highest_s = _HIGHEST_TICK * never_s
    ticks_s = [tick for tick in MaxNLocator(4).tick_values(0.0, never_s) if tick < highest_s]
    axes.set_yticks([*ticks_s, never_s], [*(f"{tick:g}" for tick in ticks_s), "never"])
