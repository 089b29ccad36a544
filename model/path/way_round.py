"""The shortest way round solids in the horizontal plane, by the visibility graph of their grown outlines.

A shortest way among convex polygons bends at their corners only (Lozano-Perez and Wesley 1979), so it is a
shortest path in the graph of the corners that see each other: docs/equations.md (78b).
"""

import math
from collections.abc import Sequence

import numpy as np

from transport.model.arrays import Array
from transport.model.physics.obstacles import Solid
from transport.model.physics.rotations import rotation

_SIDES = 12  # of the polygon about a disc
_INSIDE_M = 1e-6  # deeper than that is within a polygon


def outline(solid: Solid, radius_m: float) -> Array:
    """Return the corners of a convex polygon about a solid grown by a radius, from above.

    Args:
        solid: The solid, whose height does not count.
        radius_m: Distance to keep from it, m.
    Returns: Corners, counter-clockwise from x towards y, (k, 2), inertial frame, m.
    """
    # 0.3 s, and only ways round need it.
    from scipy.spatial import ConvexHull

    # A polygon about the disc of that radius: its sides touch the disc.
    angles = 2.0 * math.pi * (np.arange(_SIDES) + 0.5) / _SIDES
    about = (solid.radius + radius_m) / math.cos(math.pi / _SIDES)
    disc = about * np.column_stack([np.cos(angles), np.sin(angles)])

    signs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    R = np.asarray(rotation(np.array([0.0, 0.0, solid.heading_rad])))[:2, :2]
    corners = signs * solid.half[:2] @ R.T + solid.centre_I[:2]

    points = (corners[:, None] + disc).reshape(-1, 2)
    return np.asarray(points[ConvexHull(points).vertices])


def within(points: Array, polygon: Array) -> Array:
    """Return which points, (k, 2), are inside of a convex polygon by more than rounding."""
    normals, offsets = _sides(polygon)
    return np.asarray(((points @ normals.T - offsets) < -_INSIDE_M).all(axis=1))


def shortest_way(start: Array, goal: Array, polygons: Sequence[Array]) -> Array | None:
    """Return the shortest way between two points that enters no polygon; None if there is none.

    A start inside of polygons leaves them first, each by its nearest side.

    Args:
        start: Its first point, (2,), m.
        goal: Its last point, (2,), m.
        polygons: Corners of convex polygons, counter-clockwise, (k, 2) each, m.
    Returns: Points of the way with its ends, (k, 2), m.
    """
    # 0.1 s, and only ways round need it.
    from scipy.sparse.csgraph import dijkstra

    left = _left_by(start, polygons)
    points = np.vstack([left, goal, *polygons])
    is_free = ~np.any([within(points, polygon) for polygon in polygons], axis=0)
    if not is_free[:2].all():
        return None

    points = points[is_free]
    lengths = np.linalg.norm(points[:, None] - points, axis=2)
    for polygon in polygons:
        lengths[_crosses(points, polygon)] = 0.0  # no edge of the graph
    distances, before = dijkstra(lengths, indices=0, return_predecessors=True)
    if not np.isfinite(distances[1]):
        return None

    way = [1]
    while way[-1] != 0:
        way.append(int(before[way[-1]]))
    found = points[way[::-1]]
    return found if np.array_equal(left, start) else np.vstack([start, found])


def _left_by(start: Array, polygons: Sequence[Array]) -> Array:
    """Return where a start leaves the polygons that it is in, one by one; itself where it is in none."""
    place = start
    for _ in polygons:
        inside = [polygon for polygon in polygons if within(place[None], polygon)[0]]
        if not inside:
            break
        normals, offsets = _sides(inside[0])
        depths = offsets - normals @ place
        nearest = int(depths.argmin())
        place = np.asarray(place + depths[nearest] * normals[nearest])
    return place


def _sides(polygon: Array) -> tuple[Array, Array]:
    """Return the outer normals of the sides of a polygon, (k, 2), and their offsets, (k,): n x = c."""
    along = np.roll(polygon, -1, axis=0) - polygon
    normals = np.column_stack([along[:, 1], -along[:, 0]])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return normals, (normals * polygon).sum(axis=1)


def _crosses(points: Array, polygon: Array) -> Array:
    """Return between which pairs of points, (k, k), the segment enters the inside of a polygon."""
    normals, offsets = _sides(polygon)
    # Along a + s (b - a), each side is passed where n a + s n (b - a) = c.
    excess = points @ normals.T - (offsets - _INSIDE_M)  # (k, sides), negative inside
    a = excess[:, None, :]
    change = excess[None, :, :] - a

    with np.errstate(divide="ignore", invalid="ignore"):
        at = -a / change
    enters = np.where(change < 0.0, at, np.where((change == 0.0) & (a >= 0.0), np.inf, -np.inf))
    leaves = np.where(change > 0.0, at, np.inf)
    first = np.maximum(enters.max(axis=2), 0.0)
    last = np.minimum(leaves.min(axis=2), 1.0)
    return np.asarray(last - first > 1e-9)
