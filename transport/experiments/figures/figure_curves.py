"""Curves over one quantity: the time of divergence, and means with their confidence intervals.

A scenario has a colour, and a column of panels if there are two or three; a curve of it (a distribution, a kind of
loss) has a marker and a line.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from transport.experiments.declaration import Experiment
from transport.experiments.figures.curves_of_experiment import (
    DrawnCurve,
    Scenarios,
    curves_of,
    nest,
)
from transport.experiments.figures.figure_abscissa import Abscissa
from transport.experiments.figures.figure_ordinate import (
    NEVER,
    DrawnMean,
    scale_to_ends,
    scale_to_means,
)
from transport.experiments.statistics import COST_RATIO, bars_in_words
from transport.report.figures.column import (
    NAME_IN,
    Room,
    column_panels,
    head,
    name_above,
    side_by_side,
)
from transport.report.figures.style import (
    DIVERGED,
    REFERENCE,
    TEXT,
)

# Height of a panel, of one whose curves are flat, and room above them, inches.
_PANEL_IN = 0.95
_FLAT_PANEL_IN = 0.5
_ABOVE_IN = 0.2
_BELOW_IN = 0.28
_LINE_IN = 0.1  # of the second line of the label below
# More scenarios than these share their panels; middle of the panels in parts of the width.
_MOST_COLUMNS = 3
_MIDDLE = 0.55
# A curve is flat if its means are within this share of the largest.
_FLAT = 0.01


class FigurePanel(NamedTuple):
    """A panel: its title, the name of its number, and the factor to its unit."""

    title: str
    number: str
    factor: float = 1.0


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
    "age": (FigurePanel("payload error, root mean square (cm)", "payload_rms_m", 100.0), _ATTITUDE),
    "scaling": (
        FigurePanel("agent's CPU per step (ms)", "cpu_step_p50_ms"),
        FigurePanel("team's CPU per tick (ms)", "cpu_team_tick_ms"),
        FigurePanel("plans sent (kB/s)", "plan_bytes_per_s", 1e-3),
        FigurePanel("mean cost ($10^{-3}$)", "cost_mean", 1e3),
    ),
}


def draw_curves(figure: Figure, experiment: Experiment, scenarios: Scenarios) -> None:
    """Draw the panels of an experiment, each with the curves of all scenarios, or of one in its column.

    The first panel has the times of divergence, if any run diverges.
    """
    measured = [one for own in scenarios.values() for one in own]
    columns = _columns(experiment, scenarios)
    is_alone = experiment.curves is None and len(columns) == len(scenarios)
    x = Abscissa.of(experiment, measured, columns=len(columns), is_alone=is_alone)
    curves = list(curves_of(experiment, scenarios, joined=x.is_joined))
    if x.is_growth:
        nest(curves)

    numbers = _PANELS[experiment.drawn_as]
    ends_s = [time_s for one in measured for time_s in one.diverged_s]
    heights_in = [_FLAT_PANEL_IN if _is_flat(one, curves) else _PANEL_IN for one in numbers]
    rows = _panels(
        figure,
        [_PANEL_IN, *heights_in] if ends_s else heights_in,
        columns,
        legend=_legend(experiment, curves, columns),
        labels=[x.axis.title, bars_in_words(measured, [one.number for one in numbers])],
    )

    contents = [_Content.of([one for one in curves if one.scenario in own], x) for own in columns]
    for row in rows:
        for panel, content in zip(row, contents, strict=True):
            x.apply(panel, len(content.curves))
    if ends_s:
        _draw_row_of_ends(rows[0], contents, NEVER * max(ends_s))
    for row, number in zip(rows[-len(numbers) :], numbers, strict=True):
        _draw_row(row, contents, number, is_growth=x.is_growth)


class _Content(NamedTuple):
    """The curves of a column of panels, with the places of their points."""

    curves: Sequence[DrawnCurve]
    places: Sequence[Sequence[float]]

    @classmethod
    def of(cls, curves: Sequence[DrawnCurve], x: Abscissa) -> "_Content":
        """Return some curves with their places on the axis."""
        return cls(curves, x.places_of([curve.points for curve in curves]))


def _panels(
    figure: Figure,
    heights_in: Sequence[float],
    columns: Sequence[Sequence[str]],
    *,
    legend: Sequence[Line2D],
    labels: Sequence[str],
) -> list[list[Axes]]:
    """Return the panels of an empty figure by row and column; columns have their names above them.

    Labels that are not empty stand below all panels.
    """
    lines = [label for label in labels if label]
    are_several = len(columns) > 1
    room = Room(
        top_in=_ABOVE_IN + NAME_IN * are_several, bottom_in=_BELOW_IN + _LINE_IN * (len(lines) - 1)
    )
    x_label = "\n".join(lines)
    panels = column_panels(figure, heights_in, legend=legend, x_label=x_label, room=room)
    rows = [side_by_side(panel, len(columns)) for panel in panels]
    if are_several:
        figure.supxlabel(x_label, fontsize=TEXT, x=_MIDDLE, y=0.0, va="bottom")
        for panel, (name, *_) in zip(rows[0], columns, strict=True):
            name_above(panel, name)
    return rows


def _draw_row(
    row: Sequence[Axes], contents: Sequence[_Content], number: FigurePanel, *, is_growth: bool
) -> None:
    """Draw a number in the panels of a row, which have the same axis."""
    head(row[0], number.title, legend=False)
    drawn: list[DrawnMean] = []
    for panel, content in zip(row, contents, strict=True):
        drawn += _draw_means(panel, number, content)
    is_ratio = number.number == COST_RATIO
    scale_to_means(row[0], drawn, is_ratio=is_ratio, is_growth=is_growth)


def _draw_row_of_ends(row: Sequence[Axes], contents: Sequence[_Content], never_s: float) -> None:
    """Draw the times at which runs diverge."""
    head(row[0], "time at which runs diverge (s, hollow), or never", legend=False)
    for panel, content in zip(row, contents, strict=True):
        _draw_divergence(panel, content, never_s)


def _columns(experiment: Experiment, scenarios: Scenarios) -> list[list[str]]:
    """Return the scenarios of each column of panels: one, if there are few; or all of them in one column."""
    if experiment.drawn_as == "curves" and len(scenarios) <= _MOST_COLUMNS:
        return [[name] for name in scenarios]
    return [list(scenarios)]


def _legend(
    experiment: Experiment, curves: Sequence[DrawnCurve], columns: Sequence[Sequence[str]]
) -> list[Line2D]:
    """Return the legend: all curves, or what the columns have in common."""
    if len(columns) == 1:
        return [Line2D([], [], **curve.style) for curve in curves]
    if experiment.curves is None:
        return []
    common = {
        str(curve.style["label"]).removeprefix(f"{curve.scenario}, "): curve.style
        for curve in curves
    }
    return [
        Line2D([], [], **{**style, "label": name, "color": REFERENCE})
        for name, style in common.items()
    ]


def _is_flat(content: FigurePanel, curves: Sequence[DrawnCurve]) -> bool:
    """Return whether no curve of a panel changes along the axis."""
    for curve in curves:
        values = [one.mean(content.number) for one in curve.points]
        means = [mean for mean in values if mean is not None]
        if means and max(means) - min(means) > _FLAT * max(map(abs, means)):
            return False
    return True


def _draw_means(panel: Axes, number: FigurePanel, content: _Content) -> list[DrawnMean]:
    """Draw a number of every curve with its error bars; return all means with the ends of their bars."""
    drawn: list[DrawnMean] = []
    for curve_places, curve in zip(content.places, content.curves, strict=True):
        means = [one.mean(number.number) for one in curve.points]
        heights = [math.nan if mean is None else number.factor * mean for mean in means]
        bars = number.factor * np.array([one.bar(number.number) for one in curve.points]).T
        panel.errorbar(curve_places, heights, bars, capsize=1.5, elinewidth=0.8, **curve.style)
        drawn += [
            DrawnMean(height, height - below, height + above)
            for height, below, above in zip(heights, *bars, strict=True)
            if not math.isnan(height)
        ]
    return drawn


def _draw_divergence(axes: Axes, content: _Content, never_s: float) -> None:
    """Draw the mean time at which runs diverged and its range.

    Points with completed runs have a mark at the height of "never", too.
    """
    for curve_places, (_, points, style) in zip(content.places, content.curves, strict=True):
        dots = style | {"linestyle": "none"}
        for place, one in zip(curve_places, points, strict=True):
            if one.completed:
                axes.plot([place], [never_s], **dots)
            if one.diverged_s:
                ends_s = [one.diverged_s[0], one.diverged_s[-1]]
                axes.plot([place, place], ends_s, color=style["color"], linewidth=0.8)
                axes.plot([place], [statistics.fmean(one.diverged_s)], **dots | DIVERGED)
    scale_to_ends(axes, never_s)
