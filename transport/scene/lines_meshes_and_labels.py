"""Parts of a drawing: lines, meshes and labels in frames, and the solids of which bodies are made.

Every part names the frame in which its points are constant.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from transport.model.arrays import Array

Colour = tuple[int, int, int]
Pose = tuple[Array, Array]  # position, (3,), and rotation to the inertial frame, (3, 3)

# Points around a drawn circle.
_AROUND = 16


class LineSegments(NamedTuple):
    """Segments in a frame.

    Attributes:
        width: Width on the screen, pixels.
        segments: End points, (k, 2, 3).
        colours: Colours, (k, 3), 0..255.
    """

    name: str
    frame: str
    layer: str
    width: float
    segments: Array
    colours: Array


class Mesh(NamedTuple):
    """Vertices, (V, 3), in a frame, and triangles, (F, 3), that face outwards."""

    name: str
    frame: str
    layer: str
    vertices: Array
    faces: npt.NDArray[np.int32]
    colour: Colour
    opacity: float


class Label(NamedTuple):
    """Text at a position, (3,), in a frame; it faces the reader."""

    name: str
    frame: str
    layer: str
    text: str
    position: Array
    colour: Colour


Part = LineSegments | Mesh | Label


def quaternion(R: Array) -> Array:
    """Return the quaternion (w, x, y, z) of a rotation matrix, (4,)."""
    return np.asarray(np.roll(Rotation.from_matrix(R).as_quat(), 1))


def segments(path: Array) -> Array:
    """Return the segments of a path, (k, 2, 3), from its points, (k + 1, 3)."""
    return np.stack([path[:-1], path[1:]], axis=1)


def lines(
    name: str, frame: str, layer: str, width: float, coloured: Iterable[tuple[Colour, Array]]
) -> LineSegments:
    """Return segments, (k, 2, 3) each, in their colours."""
    all_segments = [np.zeros((0, 2, 3))]
    all_colours = [np.zeros((0, 3))]
    for colour, piece in coloured:
        all_segments.append(piece)
        all_colours.append(np.tile(colour, (len(piece), 1)))
    return LineSegments(
        name, frame, layer, width, np.concatenate(all_segments), np.concatenate(all_colours)
    )


def solid(
    name: str, frame: str, points: Array, colour: Colour, *, layer: str = "", opacity: float = 1.0
) -> Mesh:
    """Return the convex hull of points, (V, 3), with triangles that face outwards."""
    hull = ConvexHull(points)

    # The normal of a triangle by the order of its corners, against the outward one of the hull.
    a, b, c = points[hull.simplices].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    outwards = hull.equations[:, :3]
    faces_inwards = np.einsum("ij,ij->i", normals, outwards) < 0.0

    faces = np.where(faces_inwards[:, None], hull.simplices[:, ::-1], hull.simplices)
    return Mesh(name, frame, layer, points, faces, colour, opacity)


def prism(flat: Array, *heights: float) -> Array:
    """Return points, (k, 2), at each of some heights, (heights k, 3)."""
    return np.vstack([np.column_stack([flat, np.full(len(flat), z)]) for z in heights])


def ball(radius: float) -> Array:
    """Return points of a sphere, (18, 3)."""
    ends = (-1, 0, 1)
    cube = np.array([(x, y, z) for x in ends for y in ends for z in ends])
    # All but the middle, in every direction of a cube's corners, edges and faces.
    directions = cube[np.abs(cube).sum(axis=1) > 0]
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    points: Array = radius * directions / lengths
    return points


def disc(radius: float, *heights: float) -> Array:
    """Return points of a flat cylinder about the z axis between heights, (16 heights, 3)."""
    angles = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    return prism(radius * circle, *heights)
