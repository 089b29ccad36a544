"""Payload error over networks: a panel for each weather, a curve for each controller."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from transport.experiments.statistics import PointStatistics, bars_in_words, values_of
from transport.experiments.weather_experiment import NETWORKS
from transport.report.figures.column import Room, column_panels, head
from transport.report.figures.style import DIVERGED, looks_of

# Height of a panel, and room around it, inches.
_PANEL_IN = 0.62
_ROOM = Room(left_in=0.5, top_in=0.2, bottom_in=0.6)
_BESIDE = 0.5  # room at both ends of the axis, of the distance of two networks
_APART = 0.16  # distance of two controllers on a network, so that equal errors are seen
_NUMBER = "payload_rms_m"
# Highest error and diverged points, of the height of a panel.
_HIGHEST, _TOP = 0.8, 0.93


def draw_weather(figure: Figure, scenarios: Mapping[str, Sequence[PointStatistics]]) -> None:
    """Draw the payload error, rms, with its error bars; diverged runs are marked at the top.

    Controllers stand beside each other. One that has one network only is a horizontal line: it needs none, or has none.
    """
    measured = [statistics for own in scenarios.values() for statistics in own]
    air = values_of(measured, "weather")
    styles = {name: look.style(look.line) for name, look in looks_of(list(scenarios)).items()}
    panels = column_panels(
        figure,
        [_PANEL_IN] * len(air),
        legend=[Line2D([], [], label=name, **style) for name, style in styles.items()],
        x_label="\n".join(filter(None, ("network", bars_in_words(measured, [_NUMBER])))),
        room=_ROOM,
    )
    for panel, weather in zip(panels, air, strict=True):
        for number, (name, own) in enumerate(scenarios.items()):
            points = [one for one in own if one.point.labels["weather"] == weather]
            _draw(panel, points, styles[name], _APART * (number - (len(scenarios) - 1) / 2.0))
        head(panel, f"{weather}: payload error, m rms", legend=False)
        panel.set_xlim(-_BESIDE, len(NETWORKS) - 1 + _BESIDE)
        panel.set_ylim(0.0, panel.get_ylim()[1] / _HIGHEST)
        panel.set_xticks(range(len(NETWORKS)), [name.replace(", ", ",\n") for name in NETWORKS])


def _draw(
    panel: Axes, points: Sequence[PointStatistics], style: dict[str, Any], beside: float
) -> None:
    """Draw the points of a controller in one weather, so far beside their networks."""
    networks = list(NETWORKS)
    places = [networks.index(str(one.point.labels["network"])) + beside for one in points]
    # No line leads over a point without a completed run.
    means = [math.nan if (mean := one.mean(_NUMBER)) is None else mean for one in points]
    bars = [one.bar(_NUMBER) for one in points]

    at_top: Any = {"transform": panel.get_xaxis_transform(), "clip_on": False}
    for place, one in zip(places, points, strict=True):
        if one.completed < one.runs:
            panel.plot(place, _TOP, **at_top, **style | DIVERGED)
    if len(points) == 1 and math.isfinite(means[0]):
        line = {"color": style["color"], "linestyle": style["linestyle"]}
        panel.axhline(means[0], linewidth=0.8, **line)
    panel.errorbar(places, means, yerr=np.array(bars).T, linewidth=0.8, capsize=1.5, **style)
