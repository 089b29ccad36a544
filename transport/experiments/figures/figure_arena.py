"""Matrices of the arena: tasks in rows, algorithms in columns, in each cell one mark for each network."""

import math
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import NullLocator

from transport.experiments.arena.arena_tasks_and_networks import NETWORKS
from transport.experiments.statistics import PointStatistics
from transport.report.figures.column import Room, column_panels, head, text_width_in
from transport.report.figures.style import COLUMN_IN, MARKER, styles_of

_ROW_IN = 0.27
_LEAST_IN = 0.5  # height of the matrix, so that numbers of a scale are apart
_SLANT_DEG = 40.0  # of the names of algorithms
_BELOW_IN = 0.1  # beside the height of the names
_BESIDE_NAME_IN = 0.08
_TITLE_IN = 0.3  # of two lines
_RIGHT_IN, _RIGHT_OF_SCALE_IN = 0.08, 0.42
_BAR_GAP_IN, _BAR_IN = 0.08, 0.09
_LEAST_SPAN = 1.001  # of a scale, at least this ratio
# Marks and tiles of a cell stand in two rows: distance of marks, and size of a tile of that distance.
_DOWN = 2
_SPREAD = 0.88
_TILE = 0.9
_NONE: Any = {"facecolor": "#ffffff", "edgecolor": "#b0b0b0", "linewidth": 0.4, "hatch": "//////"}
_FILLS = {"all complete": "full", "some do": "left", "none does": "none"}

_LABELS = {"none": "no network"}  # of networks in the legend

_Place = tuple[float, float]


def draw_arena(figure: Figure, measured: Sequence[PointStatistics]) -> None:
    """Draw which runs complete: filled marks all, half filled ones some, hollow ones none.

    A place without mark was not flown.
    """
    networks = _networks(measured)
    styles = styles_of(networks)
    shown = [
        Line2D([], [], label=_LABELS.get(name, name), **_mark(styles[name], "full"))
        for name in networks
    ]
    grey = ("#555555", "o", "")
    fills = [Line2D([], [], label=text, **_mark(grey, fill)) for text, fill in _FILLS.items()]
    pairs = zip_longest(shown, fills)  # a legend is filled by columns: networks are its first row
    legend = [handle for pair in pairs for handle in pair if handle is not None]
    panel = _matrix(figure, measured, legend=legend)
    for one, (column, row) in _places(measured, networks):
        if one.runs:
            share = one.completed / one.runs
            fill = "full" if share == 1.0 else "left" if share else "none"
            style = styles[str(one.point.labels["network"])]
            panel.plot([column], [row], **_mark(style, fill))


def draw_measure(
    figure: Figure, measured: Sequence[PointStatistics], number: str, title: str, factor: float
) -> None:
    """Draw a number of completed runs as colours, a tile for each network; hatched: none completes."""
    networks = _networks(measured)
    means = {id(one): one.mean(number) for one in measured if _has(one, number)}
    values = [factor * mean for mean in means.values() if mean] or [1.0]
    scale = LogNorm(min(values), max(*values, _LEAST_SPAN * min(values)))
    colours = ScalarMappable(scale)
    panel = _matrix(figure, measured, right_in=_RIGHT_OF_SCALE_IN)
    across = _across(networks)
    rows = [networks[i : i + across] for i in range(0, len(networks), across)]
    width, height = _TILE * _SPREAD / across, _TILE * _SPREAD / _DOWN
    cell = f"\nin a cell: {' / '.join(', '.join(row) for row in rows)}" if len(networks) > 1 else ""
    head(panel, f"{title}{cell}", legend=False)
    for one, (column, row) in _places(measured, networks):
        corner = (column - width / 2.0, row - height / 2.0)
        mean = means.get(id(one))
        if mean:
            (colour,) = colours.to_rgba(np.array([factor * mean]))
            panel.add_patch(Rectangle(corner, width, height, color=colour, linewidth=0.0))
        elif one.runs and not one.completed:
            panel.add_patch(Rectangle(corner, width, height, **_NONE))

    _draw_scale(figure, panel, colours, (min(values), max(values)))


def _draw_scale(
    figure: Figure, panel: Axes, colours: ScalarMappable, ends: tuple[float, float]
) -> None:
    """Draw the colour bar beside a matrix, with its ends and its middle as numbers."""
    place = panel.get_position()
    left = place.x1 + _BAR_GAP_IN / COLUMN_IN
    axes = figure.add_axes((left, place.y0, _BAR_IN / COLUMN_IN, place.height))
    bar = figure.colorbar(colours, cax=axes)
    low, high = ends
    ticks = list(dict.fromkeys([low, math.sqrt(low * high), high]))
    axes.yaxis.set_minor_locator(NullLocator())
    bar.set_ticks(ticks, labels=[f"{tick:.3g}" for tick in ticks])


def _has(one: PointStatistics, number: str) -> bool:
    return number == "cost_ratio" or number in one.numbers


def _mark(style: tuple[str, str, str], fill: str) -> dict[str, Any]:
    """Return the mark of a network, filled by the share of completed runs."""
    colour, marker, _ = style
    return {
        "color": colour,
        "marker": marker,
        "linestyle": "none",
        "markersize": MARKER,
        "markeredgewidth": 0.6,
        "fillstyle": fill,
    }


def _values(measured: Sequence[PointStatistics], label: str) -> list[str]:
    """Return the values of a label in their order."""
    return list(dict.fromkeys(str(one.point.labels[label]) for one in measured))


def _networks(measured: Sequence[PointStatistics]) -> list[str]:
    found = _values(measured, "network")
    return [name for name in NETWORKS if name in found]


def _matrix(
    figure: Figure,
    measured: Sequence[PointStatistics],
    *,
    legend: Sequence[Line2D] = (),
    right_in: float = _RIGHT_IN,
) -> Axes:
    """Return the panel of an empty figure: a row for each task, a column for each algorithm."""
    tasks = _values(measured, "task")
    algorithms = _values(measured, "algorithm")
    names = [name.rpartition(":")[2] for name in algorithms]
    room = Room(
        left_in=max(map(text_width_in, tasks)) + _BESIDE_NAME_IN,
        right_in=right_in,
        top_in=0.12 if legend else _TITLE_IN,
        bottom_in=_BELOW_IN + math.sin(math.radians(_SLANT_DEG)) * max(map(text_width_in, names)),
    )
    (panel,) = column_panels(
        figure, [max(_ROW_IN * len(tasks), _LEAST_IN)], legend=legend, x_label="", room=room
    )
    panel.set(xlim=(-0.5, len(algorithms) - 0.5), ylim=(len(tasks) - 0.5, -0.5))
    slant: Any = {"rotation": _SLANT_DEG, "ha": "right", "rotation_mode": "anchor"}
    panel.set_xticks(range(len(algorithms)), names, **slant)
    panel.set_yticks(range(len(tasks)), tasks)
    panel.tick_params(length=0.0)
    panel.grid(visible=False)
    for edge in range(len(tasks) + 1):
        panel.axhline(edge - 0.5, color="#d9d9d9", linewidth=0.5)
    for edge in range(len(algorithms) + 1):
        panel.axvline(edge - 0.5, color="#d9d9d9", linewidth=0.5)
    return panel


def _places(
    measured: Sequence[PointStatistics], networks: Sequence[str]
) -> list[tuple[PointStatistics, _Place]]:
    """Return each point with its place in its cell: column and row of the matrix."""
    tasks = _index(_values(measured, "task"))
    algorithms = _index(_values(measured, "algorithm"))
    across = _across(networks)
    down = -(-len(networks) // across)
    places = []
    for one in measured:
        labels = one.point.labels
        row, column = divmod(networks.index(str(labels["network"])), across)
        x = algorithms[str(labels["algorithm"])] + _SPREAD / across * (column - (across - 1) / 2.0)
        y = tasks[str(labels["task"])] + _SPREAD / _DOWN * (row - (down - 1) / 2.0)
        places.append((one, (x, y)))
    return places


def _across(networks: Sequence[str]) -> int:
    """Return the number of marks beside each other in a cell."""
    return -(-len(networks) // _DOWN)


def _index(names: Sequence[str]) -> Mapping[str, int]:
    return {name: place for place, name in enumerate(names)}
