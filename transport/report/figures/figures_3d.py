"""3D figure of a run, with the formation at the ends of the phases."""

import itertools
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

from transport.analysis.series import Series
from transport.model.arrays import Array
from transport.model.physics.rotations import rotation
from transport.model.state import StateView
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.drawing_by_matplotlib import BRIGHTEST, UP, frame, line
from transport.report.figures.column import draw_legend, legend_height_in
from transport.report.figures.style import COLUMN_IN, PAYLOAD, REFERENCE
from transport.scene.lines_meshes_and_labels import solid
from transport.scene.payload_uav_and_obstacle_meshes import DARK_GREY, obstacles, payload_points
from transport.scene.uav_and_link_colours import uav_marker, uav_style

# Smallest distance between drawn formations, m.
_APART_M = 0.5
# Largest height of the box; room beside and below it for numbers and labels, inches.
_TALLEST_IN = 3.2
_LEFT_IN = 0.15
_RIGHT_IN = 0.4
_BELOW_IN = 0.45
_TICKS = 5  # most numbers of an axis
_BODY_OPACITY = 0.7
_OPACITY = 0.25  # of obstacles, behind which the team is seen


def draw_trajectories(figure: Figure, setup: Setup, series: Series) -> None:
    """Draw the 3D figure, altitude up, into an empty figure; at least one tick."""
    figure.set_layout_engine("none")
    figure.set_size_inches(COLUMN_IN, COLUMN_IN)
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d", facecolor="none")
    _draw_paths(axes, setup, series)
    for k in _rows_to_draw(setup, series):
        _formation(axes, setup, series, k)

    payload_I = StateView(series.x).r0_I
    flown_I = np.concatenate([series.uavs_I[series.on_rods], payload_I])
    _draw_obstacles(axes, setup, flown_I)
    frame(axes, flown_I * UP, ticks=_TICKS)
    axes.tick_params(pad=-3.0)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.labelpad = -7.0

    handles = _handles(setup)
    _fit(figure, axes, legend_height_in(handles))
    draw_legend(figure, handles)


def _handles(setup: Setup) -> list[Line2D]:
    """Return the entries of the legend."""
    uavs = [Line2D([], [], label=f"UAV{i + 1}", **uav_style(i)) for i in range(setup.system.N)]
    payload = Line2D([], [], color=PAYLOAD, label="payload")
    reference = Line2D([], [], color=REFERENCE, linestyle="--", label="reference")
    return [*uavs, payload, reference]


def _draw_paths(axes: Any, setup: Setup, series: Series) -> None:
    """Draw the paths of UAVs and payload, and their references."""
    line(axes, series.payload_reference_I, color=REFERENCE, linewidth=1.0, linestyle="--")
    uavs_I = np.where(series.on_rods[..., None], series.uavs_I, np.nan)  # released ones have left
    for i in range(setup.system.N):
        line(axes, series.uav_references_I[:, i], color=REFERENCE, linewidth=0.6, linestyle="--")
        line(axes, uavs_I[:, i], linewidth=1.3, **uav_style(i))
    line(axes, StateView(series.x).r0_I, color=PAYLOAD, linewidth=1.3)


def _draw_obstacles(axes: Any, setup: Setup, flown_I: Array) -> None:
    """Draw the obstacles about positions of the team, (k, 3), inertial frame, m."""
    for mesh in obstacles(setup, flown_I.min(axis=0), flown_I.max(axis=0)):
        colour = (*(np.array(mesh.colour) / BRIGHTEST), _OPACITY)
        faces = list(mesh.vertices[mesh.faces] * UP)
        solid = Poly3DCollection(faces, facecolors=colour, linewidths=0.0)
        axes.add_collection3d(solid, autolim=False)


def _fit(figure: Figure, axes: Any, above_in: float) -> None:
    """Let the box of a 3D drawing fill the width below the legend.

    The height of the figure fits the box.
    """
    low, high = _box(axes)
    room_in = np.array([COLUMN_IN - _LEFT_IN - _RIGHT_IN, _TALLEST_IN])
    side_in = float((room_in / (high - low)).min())
    size_in = np.array([COLUMN_IN, above_in + side_in * (high - low)[1] + _BELOW_IN])
    figure.set_size_inches(*size_in)

    middle_top_in = np.array([(COLUMN_IN + _LEFT_IN - _RIGHT_IN) / 2.0, size_in[1] - above_in])
    corner_in = middle_top_in - side_in * np.array([(low + high)[0] / 2.0, high[1]])
    axes.set_position((*(corner_in / size_in), *(side_in / size_in)))


def _box(axes: Any) -> tuple[Array, Array]:
    """Return the ends of the drawn box, (2,) each, as shares of the square of the axes."""
    corners = np.array(list(itertools.product(axes.get_xlim(), axes.get_ylim(), axes.get_zlim())))
    projected = np.column_stack([corners, np.ones(len(corners))]) @ axes.get_proj().T
    pixels = axes.transData.transform(projected[:, :2] / projected[:, 3:])
    places = axes.transAxes.inverted().transform(pixels)
    return places.min(axis=0), places.max(axis=0)


def _rows_to_draw(setup: Setup, series: Series) -> list[int]:
    """Return the last row, and those at the ends of phases, as far as the payload has moved."""
    ends_s = [0.0, *(end for _, _, end in setup.maneuver.stages())]
    rows = np.searchsorted(series.times_s, ends_s).clip(max=len(series.ticks) - 1)
    chosen: list[int] = []
    for row in [*rows.tolist(), len(series.ticks) - 1]:
        apart_m = np.linalg.norm(series.x[chosen, :3] - series.x[row, :3], axis=1)
        if apart_m.min(initial=np.inf) > _APART_M:
            chosen.append(row)
    return chosen


def _formation(axes: Any, setup: Setup, series: Series, k: int) -> None:
    """Draw payload, rods and UAVs in row k."""
    view = StateView(series.x[k])
    body = solid("payload", "payload", payload_points(setup.system), DARK_GREY)
    body_I = view.r0_I + body.vertices @ rotation(view.Theta0).T
    faces = list(body_I[body.faces] * UP)
    colour = (*(np.array(body.colour) / BRIGHTEST), _BODY_OPACITY)
    axes.add_collection3d(Poly3DCollection(faces, facecolors=colour, linewidths=0.0), autolim=False)
    corners = np.array([view.r0_I + rotation(view.Theta0) @ uav.rho for uav in setup.system.uavs])
    for i in np.flatnonzero(series.on_rods[k]):
        line(axes, np.array([series.uavs_I[k, i], corners[i]]), color="#555555", linewidth=0.8)
        style = {"color": uav_style(int(i))["color"], "marker": uav_marker(int(i))}
        line(axes, series.uavs_I[k, i], markersize=4.0, **style)
