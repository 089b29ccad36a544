"""Figure of the arena: completion of each task, then a strip of points for each other measure."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from transport.experiments.arena.arena_tasks_and_networks import NETWORKS
from transport.experiments.statistics import COST_RATIO, PointStatistics
from transport.report.figures.column import Room, column_panels, head
from transport.report.figures.style import CURVES, label_decades

_MAP_IN, _STRIP_IN = 0.9, 0.62
_LEFT_IN, _BELOW_IN = 0.62, 0.75
_SPREAD = 0.8  # of the distance of two algorithms: place of all networks of one
_SIZE = 2.2  # of a point
_FEW_DECADES = 1e3
# Number, title, factor, and whether the axis is logarithmic.
_STRIPS = (
    (COST_RATIO, "mean cost over centralized", 1.0, True),
    ("payload_rms_m", "payload error, cm rms", 100.0, True),
    ("separation_min_m", "smallest distance of two UAVs, m", 1.0, False),
    ("plan_bytes_per_s", "plans of the team, kB/s", 1e-3, True),
    ("cpu_step_p50_ms", "processor time of a step, ms", 1.0, True),
)


def draw_arena(figure: Figure, measured: Sequence[PointStatistics]) -> None:
    """Draw a column for each algorithm, in it a place for each network; a point is a task.

    In the map above, the height of a bar is the share of completed runs of a task, and a cell
    without frame was not flown. Points are means of completed runs with their 95 % intervals.
    """
    algorithms = _values(measured, "algorithm")
    networks = [name for name in NETWORKS if name in _values(measured, "network")]
    styles = dict(zip(networks, CURVES, strict=False))
    legend = [
        Line2D([], [], label=name, color=colour, marker=marker, linestyle="none", markersize=_SIZE)
        for name, (colour, marker, _) in styles.items()
    ]
    panels = column_panels(
        figure,
        [_MAP_IN, *[_STRIP_IN] * len(_STRIPS)],
        legend=legend,
        x_label="",
        room=Room(left_in=_LEFT_IN, bottom_in=_BELOW_IN),
    )
    _draw_map(panels[0], measured, algorithms, styles)
    for panel, (number, title, factor, is_log) in zip(panels[1:], _STRIPS, strict=True):
        _draw_strip(panel, measured, algorithms, styles, (number, factor))
        if is_log and panel.has_data():
            _set_logarithmic(panel)
            title = f"{title}; logarithmic"
        head(panel, title, legend=False)
    for panel in panels:
        panel.set_xlim(-0.5, len(algorithms) - 0.5)
        panel.set_xticks(range(len(algorithms)), [""] * len(algorithms))
    names = [name.rpartition(":")[2] for name in algorithms]
    panels[-1].set_xticks(range(len(algorithms)), names, rotation=40, ha="right")


def _set_logarithmic(panel: Axes) -> None:
    """Set a logarithmic axis, with plain numbers if they do not touch."""
    panel.set_yscale("log")
    low, high = panel.get_ylim()
    if high < _FEW_DECADES * low:
        label_decades(panel.yaxis)


def _values(measured: Sequence[PointStatistics], label: str) -> list[str]:
    """Return the values of a label in their order."""
    return list(dict.fromkeys(str(one.point.labels[label]) for one in measured))


def _place(one: PointStatistics, algorithms: Sequence[str], networks: Sequence[str]) -> float:
    """Return the place of a point along the axis of algorithms."""
    place = networks.index(str(one.point.labels["network"])) + 0.5
    shift = _SPREAD * (place / len(networks) - 0.5)
    return algorithms.index(str(one.point.labels["algorithm"])) + shift


def _draw_map(
    panel: Axes,
    measured: Sequence[PointStatistics],
    algorithms: Sequence[str],
    styles: dict[str, tuple[str, str, str]],
) -> None:
    """Draw the share of completed runs of each task as a bar in a cell."""
    tasks = _values(measured, "task")
    width = _SPREAD / len(styles)
    for one in measured:
        if not one.runs:
            continue
        colour = styles[str(one.point.labels["network"])][0]
        left = _place(one, algorithms, list(styles)) - width / 2.0
        row = tasks.index(str(one.point.labels["task"]))
        share = one.completed / one.runs
        frame: Any = {"linewidth": 0.3, "edgecolor": colour, "facecolor": "none"}
        panel.add_patch(Rectangle((left, row + 0.1), width, 0.8, **frame))
        panel.add_patch(Rectangle((left, row + 0.1), width, 0.8 * share, color=colour, linewidth=0))
    panel.set_ylim(len(tasks), 0.0)  # the first task is at the top
    panel.set_yticks(np.arange(len(tasks)) + 0.5, tasks)
    head(panel, "share of completed runs", legend=False)


def _draw_strip(
    panel: Axes,
    measured: Sequence[PointStatistics],
    algorithms: Sequence[str],
    styles: dict[str, tuple[str, str, str]],
    drawn: tuple[str, float],
) -> None:
    """Draw a number, times a factor, of all points."""
    number, factor = drawn
    for one in measured:
        mean = one.mean(number)
        if not mean:  # no completed run; or none of a kind, such as messages of UAVs alone
            continue
        half = one.half_width(number) or 0.0
        colour, marker, _ = styles[str(one.point.labels["network"])]
        panel.errorbar(
            _place(one, algorithms, list(styles)), factor * mean, yerr=factor * half, color=colour,
            marker=marker, markersize=_SIZE, linestyle="none", linewidth=0.5, markeredgewidth=0.3,
        )  # fmt: skip
