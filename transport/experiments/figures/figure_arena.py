"""Matrices of the arena: tasks in rows, algorithms in columns, in each cell one mark for each network."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
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
from transport.experiments.figures.colour_scale import draw_colour_bar, scale_of
from transport.experiments.statistics import COST_RATIO, PointStatistics, values_of
from transport.report.figures.column import Room, column_panels, head, in_rows, text_width_in
from transport.report.figures.style import Look, looks_of

# Height of a row, of the matrix at least so that numbers of a scale are apart, and room around it, inches.
_ROW_IN = 0.27
_LEAST_IN = 0.5
_BELOW_NAMES_IN = 0.1
_BESIDE_NAME_IN = 0.08
_BELOW_LEGEND_IN = 0.12
_TITLE_IN = 0.3  # of two lines
_RIGHT_IN = 0.08
_RIGHT_OF_SCALE_IN = 0.42
_SLANT_DEG = 40.0  # of the names of algorithms
_EDGE: Any = {"color": "#d9d9d9", "linewidth": 0.5}  # between cells
# Marks and tiles of a cell stand in two rows; they take this share of it, and a tile this share of its place.
_ROWS_IN_CELL = 2
_SPREAD = 0.88
_TILE = 0.9
_NONE_COMPLETES: Any = {
    "facecolor": "#ffffff",
    "edgecolor": "#b0b0b0",
    "linewidth": 0.4,
    "hatch": "//////",
}
# Fill of a mark by what completes, and its text in the legend.
_ALL, _SOME, _NONE = "full", "left", "none"
_FILLS = {_ALL: "all complete", _SOME: "some do", _NONE: "none does"}
_GREY = Look("#555555", "o", "none")

_NAMES = {"none": "no network"}  # of networks in the legend


@dataclass(frozen=True, slots=True)
class CellLayout:
    """Places of networks in a cell of the matrix, whose sides have the length 1."""

    networks: Sequence[str]

    @property
    def across(self) -> int:
        """Number of places beside each other."""
        return math.ceil(len(self.networks) / _ROWS_IN_CELL)

    @property
    def rows(self) -> list[Sequence[str]]:
        """Networks of each row, from above."""
        firsts = range(0, len(self.networks), self.across)
        return [self.networks[first : first + self.across] for first in firsts]

    def place(self, network: str) -> tuple[float, float]:
        """Return the place of a network right of the middle of the cell and below it."""
        row, column = divmod(self.networks.index(network), self.across)
        right = _SPREAD / self.across * (column - (self.across - 1) / 2.0)
        below = _SPREAD / _ROWS_IN_CELL * (row - (len(self.rows) - 1) / 2.0)
        return right, below

    @property
    def tile(self) -> tuple[float, float]:
        """Width and height of the tile of a network."""
        return _TILE * _SPREAD / self.across, _TILE * _SPREAD / _ROWS_IN_CELL


def draw_arena(figure: Figure, measured: Sequence[PointStatistics]) -> None:
    """Draw which runs complete: filled marks all, half filled ones some, hollow ones none.

    A place without mark was not flown.
    """
    layout = _layout(measured)
    looks = looks_of(layout.networks)
    panel = _matrix(figure, measured, legend=_legend(looks))
    for one, (column, row) in _places(measured, layout):
        if one.runs:
            panel.plot([column], [row], **_mark(looks[_network(one)], _fill(one)))


def _legend(looks: Mapping[str, Look]) -> list[Line2D]:
    """Return the legend: networks in its first rows, fills in the last."""
    networks = [
        Line2D([], [], label=_NAMES.get(name, name), **_mark(look, _ALL))
        for name, look in looks.items()
    ]
    fills = [Line2D([], [], label=text, **_mark(_GREY, fill)) for fill, text in _FILLS.items()]
    return in_rows([networks, fills])


def _fill(one: PointStatistics) -> str:
    """Return how much of the mark of a point is filled, by the share of its runs that complete."""
    if one.completed == one.runs:
        return _ALL
    return _SOME if one.completed else _NONE


def _mark(look: Look, fill: str) -> dict[str, Any]:
    """Return the style of a mark with a fill."""
    return {**look.style(), "markeredgewidth": 0.6, "fillstyle": fill}


def draw_measure(
    figure: Figure, measured: Sequence[PointStatistics], number: str, title: str, factor: float
) -> None:
    """Draw a number of completed runs as colours, a tile for each network; hatched: none completes.

    A logarithmic scale has no zero: a point whose mean is 0 has no tile, as one without the number.
    """
    layout = _layout(measured)
    values = [factor * (_mean(one, number) or 0.0) for one in measured]
    scale = scale_of(values)
    colours = ScalarMappable(scale).to_rgba(np.array(values))

    panel = _matrix(figure, measured, right_in=_RIGHT_OF_SCALE_IN)
    head(panel, f"{title}{_order_in_words(layout)}", legend=False)
    places = _places(measured, layout)
    for (one, place), value, colour in zip(places, values, colours, strict=True):
        if value > 0.0:
            _draw_tile(panel, place, layout, {"color": colour, "linewidth": 0.0})
        elif one.runs and not one.completed:
            _draw_tile(panel, place, layout, _NONE_COMPLETES)
    _draw_scale(figure, panel, scale, values)


def _draw_scale(figure: Figure, panel: Axes, scale: LogNorm, values: Sequence[float]) -> None:
    """Draw the colour bar of a matrix, with the smallest and largest value and their geometric mean."""
    bar = draw_colour_bar(figure, [panel], scale)
    bar.ax.yaxis.set_minor_locator(NullLocator())
    shown = [value for value in values if value > 0.0] or [1.0]
    low, high = min(shown), max(shown)
    ticks = list(dict.fromkeys([low, math.sqrt(low * high), high]))
    bar.set_ticks(ticks, labels=[f"{tick:.3g}" for tick in ticks])


def _mean(one: PointStatistics, number: str) -> float | None:
    """Return the mean of a number of a point; None without one."""
    has_number = number == COST_RATIO or number in one.numbers
    return one.mean(number) if has_number else None


def _order_in_words(layout: CellLayout) -> str:
    """Return the line of a title that tells the order of networks in a cell; empty for a single one."""
    if len(layout.networks) <= 1:
        return ""
    return f"\nin a cell: {' / '.join(', '.join(row) for row in layout.rows)}"


def _draw_tile(
    panel: Axes, place: tuple[float, float], layout: CellLayout, style: Mapping[str, Any]
) -> None:
    """Draw the tile of a network about its place."""
    column, row = place
    width, height = layout.tile
    corner = (column - width / 2.0, row - height / 2.0)
    panel.add_patch(Rectangle(corner, width, height, **style))


def _layout(measured: Sequence[PointStatistics]) -> CellLayout:
    """Return the layout of a cell with the networks of some points."""
    flown = {_network(one) for one in measured}
    return CellLayout([name for name in NETWORKS if name in flown])


def _network(one: PointStatistics) -> str:
    return str(one.point.labels["network"])


def _matrix(
    figure: Figure,
    measured: Sequence[PointStatistics],
    *,
    legend: Sequence[Line2D] = (),
    right_in: float = _RIGHT_IN,
) -> Axes:
    """Return the panel of an empty figure: a row for each task, a column for each algorithm."""
    tasks = [str(task) for task in values_of(measured, "task")]
    algorithms = [str(name) for name in values_of(measured, "algorithm")]
    names = _short(algorithms)
    slant = math.sin(math.radians(_SLANT_DEG))
    room = Room(
        left_in=max(map(text_width_in, tasks)) + _BESIDE_NAME_IN,
        right_in=right_in,
        top_in=_BELOW_LEGEND_IN if legend else _TITLE_IN,
        bottom_in=_BELOW_NAMES_IN + slant * max(map(text_width_in, names)),
    )
    height_in = max(_ROW_IN * len(tasks), _LEAST_IN)
    (panel,) = column_panels(figure, [height_in], legend=legend, x_label="", room=room)

    panel.set(xlim=(-0.5, len(algorithms) - 0.5), ylim=(len(tasks) - 0.5, -0.5))
    panel.set_xticks(
        range(len(names)), names, rotation=_SLANT_DEG, ha="right", rotation_mode="anchor"
    )
    panel.set_yticks(range(len(tasks)), tasks)
    panel.tick_params(length=0.0)
    panel.grid(visible=False)
    for edge in range(len(tasks) + 1):
        panel.axhline(edge - 0.5, **_EDGE)
    for edge in range(len(algorithms) + 1):
        panel.axvline(edge - 0.5, **_EDGE)
    return panel


def _places(
    measured: Sequence[PointStatistics], layout: CellLayout
) -> Iterator[tuple[PointStatistics, tuple[float, float]]]:
    """Yield each point with its place: columns and rows of the matrix, from the middle of the first cell."""
    tasks = values_of(measured, "task")
    algorithms = values_of(measured, "algorithm")
    for one in measured:
        labels = one.point.labels
        right, below = layout.place(_network(one))
        column = algorithms.index(labels["algorithm"]) + right
        row = tasks.index(labels["task"]) + below
        yield one, (column, row)


def _short(algorithms: Sequence[str]) -> list[str]:
    """Return the names of algorithms: that of a class without its file, unless a scenario is named alike."""
    scenarios = {name.casefold() for name in algorithms if ":" not in name}
    return [
        name if (short := name.rpartition(":")[2]).casefold() in scenarios else short
        for name in algorithms
    ]
