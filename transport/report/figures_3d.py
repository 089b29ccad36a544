"""Drawings by matplotlib, in space and from above.

3D figure of a run with the formation at the ends of the phases.
"""

import itertools
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection  # type: ignore[import-untyped]

from transport.analysis.series import Series
from transport.model.arrays import Array
from transport.model.rotations import rotation
from transport.model.state import StateView
from transport.protocol.scenario.setup import Setup
from transport.report.column import draw_legend, legend_height_in
from transport.report.style import COLUMN_IN, PAYLOAD, REFERENCE
from transport.scene.bodies import obstacles
from transport.scene.colours import uav_style
from transport.scene.parts import Label, Lines, Mesh, Part, Pose

# Smallest distance between drawn formations, m; shortest axis of the box in parts of the longest.
_APART_M, _SLIMMEST = 0.5, 0.3
# Largest height of the box; room beside and below it for numbers and labels, inches; most numbers
# of an axis.
_TALLEST_IN, _LEFT_IN, _RIGHT_IN, _BELOW_IN = 3.2, 0.15, 0.4, 0.45
_TICKS = 5
# Of obstacles, behind which the team is seen.
_OPACITY = 0.25
UP = np.array([1.0, 1.0, -1.0])  # z points down in the data and up on paper


def draw_trajectories(figure: Figure, setup: Setup, series: Series) -> None:
    """Draw the 3D figure, altitude up, into an empty figure; at least one tick."""
    handles = [Line2D([], [], label=f"UAV{i + 1}", **uav_style(i)) for i in range(setup.system.N)]
    handles.append(Line2D([], [], color=PAYLOAD, label="payload"))
    handles.append(Line2D([], [], color=REFERENCE, linestyle="--", label="reference"))
    above_in = legend_height_in(handles)
    figure.set_layout_engine("none")
    figure.set_size_inches(COLUMN_IN, COLUMN_IN)
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d", facecolor="none")
    payload_I = StateView(series.x).r0_I
    line(axes, series.payload_reference_I, color=REFERENCE, linewidth=1.0, linestyle="--")
    uavs_I = np.where(series.on_rods[..., None], series.uavs_I, np.nan)  # released ones have left
    for i in range(setup.system.N):
        line(axes, series.uav_references_I[:, i], color=REFERENCE, linewidth=0.6, linestyle="--")
        line(axes, uavs_I[:, i], linewidth=1.3, **uav_style(i))
    line(axes, payload_I, color=PAYLOAD, linewidth=1.3)
    for k in _rows_to_draw(setup, series):
        _formation(axes, setup, series, k)
    everything = np.concatenate([series.uavs_I[series.on_rods], payload_I])
    for mesh in obstacles(setup, everything.min(axis=0), everything.max(axis=0)):
        colour = (*(np.array(mesh.colour) / 255.0), _OPACITY)
        solid = list(mesh.vertices[mesh.faces] * UP)
        axes.add_collection3d(
            Poly3DCollection(solid, facecolors=colour, linewidths=0.0), autolim=False
        )
    frame(axes, everything * UP, ticks=_TICKS)
    axes.tick_params(pad=-3.0)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.labelpad = -7.0
    _fit(figure, axes, above_in)
    draw_legend(figure, handles)


def _fit(figure: Figure, axes: Any, above_in: float) -> None:
    """Let the box of a 3D drawing fill the width below the legend, and the height of the figure fit it."""
    corners = np.array(list(itertools.product(axes.get_xlim(), axes.get_ylim(), axes.get_zlim())))
    projected = np.column_stack([corners, np.ones(len(corners))]) @ axes.get_proj().T
    places = axes.transAxes.inverted().transform(
        axes.transData.transform(projected[:, :2] / projected[:, 3:])
    )
    low, high = places.min(axis=0), places.max(axis=0)  # shares of the square
    side_in = float(
        (np.array([COLUMN_IN - _LEFT_IN - _RIGHT_IN, _TALLEST_IN]) / (high - low)).min()
    )
    size_in = np.array([COLUMN_IN, above_in + side_in * (high - low)[1] + _BELOW_IN])
    figure.set_size_inches(*size_in)
    middle_top_in = np.array([(COLUMN_IN + _LEFT_IN - _RIGHT_IN) / 2.0, size_in[1] - above_in])
    corner_in = middle_top_in - side_in * np.array([(low + high)[0] / 2.0, high[1]])
    axes.set_position((*(corner_in / size_in), *(side_in / size_in)))


def _rows_to_draw(setup: Setup, series: Series) -> list[int]:
    """Return the rows at the ends of the phases, at new positions of the reference, and the last."""
    ends_s = [0.0, *(end for _, _, end in setup.maneuver.stages())]
    rows = np.searchsorted(series.times_s, ends_s).clip(max=len(series.ticks) - 1)
    chosen: list[int] = []
    for row in [*rows.tolist(), len(series.ticks) - 1]:
        apart_m = np.linalg.norm(series.x[chosen, :3] - series.x[row, :3], axis=1)
        if apart_m.min(initial=np.inf) > _APART_M:
            chosen.append(row)
    return chosen


def _formation(axes: Any, setup: Setup, series: Series, k: int) -> None:
    """Draw rods, UAVs and the outline of the payload in row k."""
    view = StateView(series.x[k])
    corners = np.array([view.r0_I + rotation(view.Theta0) @ uav.rho for uav in setup.system.uavs])
    for i in np.flatnonzero(series.on_rods[k]):
        line(axes, np.array([series.uavs_I[k, i], corners[i]]), color="#555555", linewidth=0.8)
        line(
            axes, series.uavs_I[k, i], marker="o", markersize=4.0, color=uav_style(int(i))["color"]
        )
    line(axes, np.vstack([corners, corners[:1]]), color=PAYLOAD, linewidth=2.0)
    line(axes, view.r0_I, marker="s", markersize=4.0, color=PAYLOAD)


def frame(axes: Any, points: Array, *, zoom: float = 0.95, ticks: int = 8) -> None:
    """Set equal scales on all axes, around the points with a margin, with so many numbers at most."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.05 * float((high - low).max()) + 0.1
    low, high = low - margin, high + margin
    # A maneuver that only climbs needs width for the labels.
    widen = np.maximum(0.0, _SLIMMEST * float((high - low).max()) - (high - low)) / 2.0
    low, high = low - widen, high + widen
    # z points down: with x to the right, y points towards the reader; otherwise the drawing is a
    # mirror image.
    axes.set(
        xlim=(low[0], high[0]),
        ylim=(high[1], low[1]),
        zlim=(low[2], high[2]),
        xlabel="x (m)",
        ylabel="y (m)",
    )
    axes.set_box_aspect(high - low, zoom=zoom)
    for axis, share in zip(
        (axes.xaxis, axes.yaxis, axes.zaxis), (high - low) / (high - low).max(), strict=True
    ):
        axis.set_major_locator(MaxNLocator(nbins=1 + round(ticks * share), steps=[1, 2, 5, 10]))
    axes.set_zlabel("altitude, -z (m)", labelpad=10.0)
    axes.view_init(elev=18.0, azim=-60.0)


def draw_parts(
    axes: Any, parts: Iterable[Part], poses: Mapping[str, Pose], *, above: bool, width: float
) -> list[Any]:
    """Draw parts of a drawing in their poses, in space with altitude up, or from above.

    Return the drawn artists.

    Lines have `width` points for a pixel on the screen. From above, meshes are transparent, so that
    nothing is hidden.
    """
    solid, faces, segments, colours, widths, drawn = [], [], [], [], [], []
    for part in (part for part in parts if part.frame in poses):
        position, R = poses[part.frame]
        match part:
            case Mesh():
                solid += list((part.vertices @ R.T + position)[part.faces] * UP)
                faces += [(*(np.array(part.colour) / 255.0), 0.2 if above else part.opacity)] * len(
                    part.faces
                )
            case Lines():
                segments += list((part.segments @ R.T + position) * UP)
                colours += list(part.colours / 255.0)
                widths += [width * part.width] * len(part.segments)
            case Label() if above:
                x, y, _ = part.position + position  # labels face the reader
                style = {"fontsize": 8.0, "color": np.array(part.colour) / 255.0, "weight": "bold"}
                drawn.append(axes.text(x, y, part.text, ha="center", va="center", **style))
    line_style: Any = {"colors": colours, "linewidths": widths}
    if above:
        order = np.argsort([triangle[:, 2].mean() for triangle in solid])
        flat = LineCollection([piece[:, :2] for piece in segments], **line_style)
        bodies = [solid[k][:, :2] for k in order]
        polygons = PolyCollection(bodies, facecolors=[faces[k] for k in order], linewidths=0.0)
        return [*drawn, axes.add_collection(flat), axes.add_collection(polygons)]
    mesh = Poly3DCollection(solid, facecolors=faces, linewidths=0.0)
    return [
        axes.add_collection3d(artist, autolim=False)
        for artist in (Line3DCollection(segments, **line_style), mesh)
    ]


def line(axes: Any, points_I: Array, **style: Any) -> None:
    """Draw a path, (k, 3), or a point, (3,), inertial frame, m."""
    axes.plot(*(points_I * UP).T, **style)
