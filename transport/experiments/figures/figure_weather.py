"""Payload error over networks: a panel for each weather, a curve for each controller."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from transport.experiments.statistics import PointStatistics
from transport.experiments.weather_experiment import NETWORKS
from transport.report.figures.column import Room, column_panels, head
from transport.report.figures.style import DIVERGED, MARKER, styles_of

_PANEL_IN = 0.62
_LEFT_IN, _RIGHT_IN, _ABOVE_IN, _BELOW_IN = 0.5, 0.2, 0.2, 0.5
_NUMBER = "payload_rms_m"
_BESIDE = 1.0  # place of diverged points, of the height of a panel: below its title


def draw_weather(figure: Figure, scenarios: Mapping[str, Sequence[PointStatistics]]) -> None:
    """Draw the payload error, rms, with its error bars; diverged runs are marked at the top.

    A controller that has one network only is a horizontal line: it needs none, or has none.
    """
    measured = [statistics for own in scenarios.values() for statistics in own]
    air = list(dict.fromkeys(str(statistics.point.labels["weather"]) for statistics in measured))
    styles = styles_of(list(scenarios))
    legend = []
    for name, (colour, marker, line) in styles.items():
        style: dict[str, Any] = {"color": colour, "marker": marker, "linestyle": line}
        legend.append(Line2D([], [], label=name, markersize=MARKER, **style))
    panels = column_panels(
        figure,
        [_PANEL_IN] * len(air),
        legend=legend,
        x_label="network",
        room=Room(left_in=_LEFT_IN, right_in=_RIGHT_IN, top_in=_ABOVE_IN, bottom_in=_BELOW_IN),
    )
    for panel, weather in zip(panels, air, strict=True):
        for name, own in scenarios.items():
            points = [one for one in own if one.point.labels["weather"] == weather]
            _draw(panel, points, styles[name])
        head(panel, f"{weather}: payload error, m rms", legend=False)
        panel.set_xlim(-0.4, len(NETWORKS) - 0.6)
        panel.set_ylim(bottom=0.0)
        panel.set_xticks(range(len(NETWORKS)), [name.replace(", ", ",\n") for name in NETWORKS])


def _draw(panel: Axes, points: Sequence[PointStatistics], style: tuple[str, str, str]) -> None:
    """Draw the points of a controller in one weather."""
    colour, marker, line = style
    networks = list(NETWORKS)
    places, means, bars = [], [], []
    for one in points:
        place = networks.index(str(one.point.labels["network"]))
        estimate = one.numbers[_NUMBER]
        # No line leads over a point without a completed run.
        places.append(place)
        means.append(math.nan if estimate is None else estimate.mean)
        bars.append(one.bar(_NUMBER))
        if one.completed < one.runs:
            panel.plot(
                place, _BESIDE, marker, color=colour, markersize=MARKER,
                transform=panel.get_xaxis_transform(), clip_on=False, **DIVERGED,
            )  # fmt: skip
    if len(points) == 1 and math.isfinite(means[0]):
        panel.axhline(means[0], color=colour, linestyle=line, linewidth=0.8)
    panel.errorbar(
        places, means, yerr=np.array(bars).T, color=colour, marker=marker, linestyle=line,
        markersize=MARKER, linewidth=0.8, capsize=1.5,
    )  # fmt: skip
