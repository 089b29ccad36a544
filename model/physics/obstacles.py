"""Obstacles as boxes, also flat or endless, grown by a radius.

Distances of UAVs, rods and payload are exact to rounding. That of a payload from an endless solid
is so to 1e-9 m: the edges of the solid end `_FAR_M` from its centre and are searched by halving.
Depths inside a solid are known for points alone: segments and boxes that enter the box before its
rounding have minus the radius as their distance, however deep they are.
"""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.parameters import System, payload_half_size
from transport.model.physics.rotations import rotation

_FAR_M = 1e6  # half size in place of an infinite one, m
_WALL_M = 1e5  # half width of a wall beside a gap: no path comes near its end
_HALVINGS = 64  # of a segment: enough for the position along it to be exact to rounding


@dataclass(frozen=True, slots=True, kw_only=True)
class Solid:
    """A rounded box."""

    centre_I: Array  # (3,), inertial frame, m
    heading_rad: float  # of its first axis, from x towards y; the third is vertical
    half: Array  # half sizes along its axes before rounding, (3,), m; infinite without ends
    radius: float = 0.0  # of the rounding, m

    @property
    def R(self) -> Array:
        """Rotation from its axes to the inertial frame, (3, 3)."""
        return np.asarray(rotation(np.array([0.0, 0.0, self.heading_rad])))

    def from_points(self, r_I: Array) -> tuple[Array, Array]:
        """Return the distances of points and their gradients.

        Args:
            r_I: Points, inertial frame, (..., 3), m.
        Returns: Distances, negative inside, (...,), m, and gradients, (..., 3).
        Source: docs/equations.md (69a).
        """
        # q = R_b^T (r - c),   delta = |q - clip(q, -h, h)| - a
        # with rotation R_b, centre c, half sizes h and rounding a of the body
        q = (r_I - self.centre_I) @ self.R
        beyond = q - np.clip(q, -self.half, self.half)
        outside = np.linalg.norm(beyond, axis=-1)

        # Inside the box: minus the distance from its nearest face.
        depth = self.half - np.abs(q)
        nearest_face = np.eye(3)[np.argmin(depth, axis=-1)] * np.where(q < 0.0, -1.0, 1.0)

        is_inside = outside == 0.0
        direction = beyond / np.where(is_inside, 1.0, outside)[..., None]
        normal = np.where(is_inside[..., None], nearest_face, direction)
        distance = np.where(is_inside, -depth.min(axis=-1), outside)
        return distance - self.radius, normal @ self.R.T

    def from_segments(self, a_I: Array, b_I: Array) -> Array:
        """Return the distances of segments, without depth in the box before its rounding.

        Args:
            a_I: First ends, inertial frame, (..., 3), m.
            b_I: Second ends, likewise.
        Returns: Distances, at least minus the radius, (...,), m.
        """
        a = (a_I - self.centre_I) @ self.R
        b = (b_I - self.centre_I) @ self.R
        return _between_box_and_segments(a, b, self.half) - self.radius

    def from_boxes(self, r_I: Array, R: Array, half: Array) -> Array:
        """Return the distances of equal boxes, without depth in the box before its rounding.

        Args:
            r_I: Their centres, inertial frame, (k, 3), m.
            R: Rotations from their axes to the inertial frame, (k, 3, 3).
            half: Half sizes of each, finite, (3,), m.
        Returns: Distances, at least minus the radius, (k,), m.
        """
        # Two boxes apart: a pair of nearest points has one on an edge. Overlapping: an edge of one
        # enters the other. So the edges of each against the other box suffice, (69a).
        their_edges = np.einsum("kij,epj->kepi", R, _edges(half)) + r_I[:, None, None]
        from_theirs = self.from_segments(their_edges[:, :, 0], their_edges[:, :, 1])

        own_edges = _edges(self.half) @ self.R.T + self.centre_I
        in_their_axes = np.einsum("kij,kepi->kepj", R, own_edges - r_I[:, None, None])
        from_own = _between_box_and_segments(in_their_axes[:, :, 0], in_their_axes[:, :, 1], half)

        nearest = np.minimum(from_theirs.min(axis=1), from_own.min(axis=1) - self.radius)
        return np.asarray(nearest)


def walls_of_gap(
    middle_I: Array, heading_rad: float, width_m: float, thickness_m: float
) -> tuple[Solid, Solid]:
    """Return the two walls beside a gap that is flown through along a heading.

    Args:
        middle_I: Middle of the gap, (3,), inertial frame, m.
        heading_rad: Of the way through it, from x towards y.
        width_m: Between the walls.
        thickness_m: Of the walls.
    """
    across = np.array([-math.sin(heading_rad), math.cos(heading_rad), 0.0])
    shift_I = (width_m / 2.0 + _WALL_M) * across
    half = np.array([thickness_m / 2.0, _WALL_M, np.inf])
    return (
        Solid(centre_I=middle_I - shift_I, heading_rad=heading_rad, half=half),
        Solid(centre_I=middle_I + shift_I, heading_rad=heading_rad, half=half),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Obstacle:
    """Solids to keep clear of."""

    name: str  # for texts, such as "gap"
    solids: tuple[Solid, ...]  # one, or the two walls of a gap
    margin_m: float  # smallest distance of the centre of a UAV
    load_margin_m: float  # smallest distance of rods and payload
    penalty: float  # weight of a violation in the program of a controller, 1/m

    def from_points(self, r_I: Array) -> tuple[Array, Array]:
        """Return the distances of points from the nearest solid and their gradients.

        Args:
            r_I: Points, inertial frame, (..., 3), m.
        Returns: Distances, negative inside, (...,), m, and gradients, (..., 3).
        """
        each = [solid.from_points(r_I) for solid in self.solids]
        distances = np.array([distance for distance, _ in each])
        normals = np.array([normal for _, normal in each])

        nearest = np.argmin(distances, axis=0)[None]
        normal = np.take_along_axis(normals, nearest[..., None], axis=0)[0]
        return distances.min(axis=0), normal

    def margins(self, N: int) -> Array:
        """Return the smallest distances allowed of the bodies of N UAVs.

        Returns: Distances in the order of `clearances`, (2 N + 1,), m.
        """
        return np.repeat([self.margin_m, self.load_margin_m], [N, N + 1])


def bodies(N: int) -> list[str]:
    """Return the names of the bodies in the order of `clearances`: UAVs, rods, payload."""
    uavs = [f"UAV{i}" for i in range(1, N + 1)]
    rods = [f"rod {i}" for i in range(1, N + 1)]
    return [*uavs, *rods, "payload"]


def clearances(system: System, obstacle: Obstacle, x: Array) -> Array:
    """Return the distances of UAV centres, rods and payload from an obstacle.

    Of rods and payload that overlap a solid the depth is not told, as in `Solid`.

    Args:
        system: Parameters of the team.
        obstacle: The obstacle.
        x: States, (k, n).
    Returns: Distances of UAVs, then rods, then the payload, (k, 2 N + 1), m.
    Source: docs/equations.md (69a).
    """
    view = state.StateView(x)
    R = np.array([rotation(Theta) for Theta in x[:, state.THETA0]])
    rho = np.array([uav.rho for uav in system.uavs])
    lengths = np.array([uav.rod_length for uav in system.uavs])

    # Both ends of the rods: r0 + R rho_i, and r_i = r0 + R (rho_i - l_i e_i) at the UAVs.
    attachments = view.r0_I[:, None] + np.einsum("kij,nj->kni", R, rho)
    uavs = attachments - lengths[:, None] * np.einsum("kij,knj->kni", R, view.e_P)
    half = payload_half_size(system)

    by_solid = []
    for solid in obstacle.solids:
        from_uavs, _ = solid.from_points(uavs)
        from_rods = solid.from_segments(attachments, uavs)
        from_payload = solid.from_boxes(view.r0_I, R, half)
        by_solid.append(np.column_stack([from_uavs, from_rods, from_payload]))
    return np.asarray(np.min(by_solid, axis=0))


def _between_box_and_segments(a: Array, b: Array, half: Array) -> Array:
    """Return the distances of segments from a box about the origin, zero where they enter it.

    The distance is convex along a segment: halving leads to the zero of its slope, (69a).

    Args:
        a: First ends in the axes of the box, (..., 3), m.
        b: Second ends, likewise.
        half: Half sizes of the box, infinite without ends, (3,), m.
    Returns: Distances, (...,), m.
    """
    along = b - a
    # Axis by axis, (3, ...): half the time with many segments.
    first, way = (np.ascontiguousarray(np.moveaxis(each, -1, 0)) for each in (a, along))
    largest = half.reshape(3, *[1] * (a.ndim - 1))
    low = np.zeros(a.shape[:-1])
    high = np.ones(a.shape[:-1])
    for _ in range(_HALVINGS):
        s = (low + high) / 2.0
        p = first + s * way
        slopes = (p - np.clip(p, -largest, largest)) * way
        # Half the slope of the squared distance by s.
        is_falling = slopes[0] + slopes[1] + slopes[2] < 0.0
        low = np.where(is_falling, s, low)
        high = np.where(is_falling, high, s)

    p = a + ((low + high) / 2.0)[..., None] * along
    return np.asarray(np.linalg.norm(p - np.clip(p, -half, half), axis=-1))


def _edges(half: Array) -> Array:
    """Return the ends of all edges of a box about the origin, (edges, 2, 3), m, at most at `_FAR_M`."""
    corners = np.array(list(product((-1.0, 1.0), repeat=3)))
    pairs = []
    for a in corners:
        for b in corners:
            is_edge = np.abs(a - b).sum() == 2.0
            if is_edge and a.sum() < b.sum():  # each edge once
                pairs.append((a, b))

    ends = np.minimum(half, _FAR_M) * np.array(pairs)
    # A flat box has fewer. Adding 0 makes -0 and 0 equal rows.
    distinct = np.unique(ends.reshape(len(ends), 6) + 0.0, axis=0)
    return distinct.reshape(-1, 2, 3)
