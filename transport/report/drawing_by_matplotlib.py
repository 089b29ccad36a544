"""Parts of a scene's drawing by matplotlib, in space with altitude up, or from above."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection  # type: ignore[import-untyped]

from transport.model.arrays import Array
from transport.scene.lines_meshes_and_labels import Label, LineSegments, Mesh, Part, Pose

UP = np.array([1.0, 1.0, -1.0])  # z points down in the data and up on paper
BRIGHTEST = 255.0
_FLAT_OPACITY = 0.2  # of meshes from above, so that nothing is hidden
# Names stand above all lines, in a white rim of so many points.
_ABOVE_LINES = 5
_RIM_PT = 2.0
# Margin about the points as a share of the longest axis, and m.
_MARGIN = 0.05
_MARGIN_M = 0.1
# Shortest axis of the box in parts of the longest.
_SLIMMEST = 0.3


def frame(axes: Any, points: Array, *, zoom: float = 0.95, ticks: int = 8) -> None:
    """Set equal scales on all axes, around points, (k, 3), with a margin.

    The longest axis has about `ticks` numbers.
    """
    low, high = _box_of(points)
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

    shares = (high - low) / (high - low).max()
    for axis, share in zip((axes.xaxis, axes.yaxis, axes.zaxis), shares, strict=True):
        axis.set_major_locator(MaxNLocator(nbins=1 + round(ticks * share), steps=[1, 2, 5, 10]))
    axes.set_zlabel("altitude, -z (m)", labelpad=10.0)
    axes.view_init(elev=18.0, azim=-60.0)


def _box_of(points: Array) -> tuple[Array, Array]:
    """Return the ends of the box about points, (3,) each."""
    low = points.min(axis=0)
    high = points.max(axis=0)
    margin = _MARGIN * float((high - low).max()) + _MARGIN_M
    low = low - margin
    high = high + margin
    # A maneuver that only climbs needs width for the labels.
    slimmest = _SLIMMEST * float((high - low).max())
    missing = np.maximum(0.0, slimmest - (high - low))
    return low - missing / 2.0, high + missing / 2.0


@dataclass(slots=True)
class _Collected:
    """Faces of meshes and lines of a drawing with their colours, inertial frame, altitude up, m."""

    triangles: list[Array] = field(default_factory=list)  # (3, 3) each
    face_colours: list[tuple[float, ...]] = field(default_factory=list)
    segments: list[Array] = field(default_factory=list)  # (2, 3) each
    line_colours: list[Array] = field(default_factory=list)
    line_widths: list[float] = field(default_factory=list)

    def add_mesh(self, mesh: Mesh, pose: Pose, opacity: float) -> None:
        """Add the faces of a mesh."""
        position_I, R = pose
        corners_I = mesh.vertices @ R.T + position_I
        colour = (*(np.array(mesh.colour) / BRIGHTEST), opacity)
        self.triangles += list(corners_I[mesh.faces] * UP)
        self.face_colours += [colour] * len(mesh.faces)

    def add_lines(self, lines: LineSegments, pose: Pose, width: float) -> None:
        """Add lines of a width, points."""
        position_I, R = pose
        self.segments += list((lines.segments @ R.T + position_I) * UP)
        self.line_colours += list(lines.colours / BRIGHTEST)
        self.line_widths += [width] * len(lines.segments)

    @property
    def line_style(self) -> dict[str, Any]:
        """Colours and widths of the lines."""
        return {"colors": self.line_colours, "linewidths": self.line_widths}


def draw_parts(
    axes: Any, parts: Iterable[Part], poses: Mapping[str, Pose], *, above: bool, width: float
) -> list[Any]:
    """Draw parts of a drawing in their poses, in space with altitude up, or from above.

    Lines have `width` points for a pixel on the screen. From above, meshes are transparent, so that
    nothing is hidden. Return the drawn artists.
    """
    collected = _Collected()
    labels = []
    for part in parts:
        pose = poses.get(part.frame)
        if pose is None:
            continue
        match part:
            case Mesh():
                collected.add_mesh(part, pose, _FLAT_OPACITY if above else part.opacity)
            case LineSegments():
                collected.add_lines(part, pose, width * part.width)
            case Label() if above:
                labels.append(_draw_label(axes, part, pose))

    if above:
        return [*labels, *_draw_flat(axes, collected)]
    return _draw_in_space(axes, collected)


def _draw_label(axes: Any, label: Label, pose: Pose) -> Any:
    """Draw a text beside its frame, in inertial directions: a heading does not turn it; return it."""
    x, y, _ = label.position + pose[0]
    colour = np.array(label.colour) / BRIGHTEST
    style = {"fontsize": 8.0, "color": colour, "weight": "bold", "zorder": _ABOVE_LINES}
    text = axes.text(x, y, label.text, ha="center", va="center", **style)
    text.set_path_effects([withStroke(linewidth=_RIM_PT, foreground="#ffffff")])
    return text


def _draw_flat(axes: Any, collected: _Collected) -> list[Any]:
    """Draw lines and faces from above, the lowest faces first; return them."""
    heights = [triangle[:, 2].mean() for triangle in collected.triangles]
    upwards = np.argsort(heights)
    flat_lines = [segment[:, :2] for segment in collected.segments]
    flat_faces = [collected.triangles[k][:, :2] for k in upwards]
    colours = [collected.face_colours[k] for k in upwards]
    lines = LineCollection(flat_lines, **collected.line_style)
    faces = PolyCollection(flat_faces, facecolors=colours, linewidths=0.0)
    return [axes.add_collection(lines), axes.add_collection(faces)]


def _draw_in_space(axes: Any, collected: _Collected) -> list[Any]:
    """Draw lines and faces in space; return them."""
    lines = Line3DCollection(collected.segments, **collected.line_style)
    faces = Poly3DCollection(collected.triangles, facecolors=collected.face_colours, linewidths=0.0)
    return [
        axes.add_collection3d(lines, autolim=False),
        axes.add_collection3d(faces, autolim=False),
    ]


def line(axes: Any, points_I: Array, **style: Any) -> None:
    """Draw a path, (k, 3), or a point, (3,), inertial frame, m."""
    axes.plot(*(points_I * UP).T, **style)
