"""Obstacles as boxes, also flat or endless, grown by a radius, and exact distances from UAVs, rods and payload."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.parameters import System, payload_half_size
from transport.model.rotations import rotation

_FAR_M, _HALVINGS = (
    1e6,
    64,
)  # half size for an infinite one, m, and halvings of a segment: to rounding of it


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
        """Return distances of points, (..., 3), negative inside, m, and their gradients, (..., 3).

        (69a).
        """
        q = (r_I - self.centre_I) @ self.R
        beyond = q - np.clip(q, -self.half, self.half)
        outside, depth = np.linalg.norm(beyond, axis=-1), self.half - np.abs(q)
        nearest = np.eye(3)[np.argmin(depth, axis=-1)] * np.where(q < 0.0, -1.0, 1.0)
        within = outside == 0.0
        normal = np.where(
            within[..., None], nearest, beyond / np.where(within, 1.0, outside)[..., None]
        )
        return np.where(within, -depth.min(axis=-1), outside) - self.radius, normal @ self.R.T

    def from_segments(self, a_I: Array, b_I: Array) -> Array:
        """Return the distances of segments between points, (..., 3) each, at least minus the radius, (...,), m."""
        return (
            _apart((a_I - self.centre_I) @ self.R, (b_I - self.centre_I) @ self.R, self.half)
            - self.radius
        )

    def from_boxes(self, r_I: Array, R: Array, half: Array) -> Array:
        """Return the distances of boxes, (k,), at least minus the radius, m.

        Of centres, rotations and half sizes.
        """
        ends = np.einsum("kij,epj->kepi", R, _edges(half)) + r_I[:, None, None]
        own = _edges(self.half) @ self.R.T + self.centre_I
        seen = np.einsum("kij,kepi->kepj", R, own - r_I[:, None, None])
        theirs, ours = (
            self.from_segments(ends[:, :, 0], ends[:, :, 1]),
            _apart(seen[:, :, 0], seen[:, :, 1], half),
        )
        return np.asarray(np.minimum(theirs.min(axis=1), ours.min(axis=1) - self.radius))


@dataclass(frozen=True, slots=True, kw_only=True)
class Obstacle:
    """Solids to keep clear of."""

    name: str  # for texts, such as "gap"
    solids: tuple[Solid, ...]  # one, or the two walls of a gap
    margin_m: float  # smallest distance of the centre of a UAV
    load_margin_m: float  # smallest distance of rods and payload
    penalty: float  # weight of a violation in the program of a controller, 1/m

    def from_points(self, r_I: Array) -> tuple[Array, Array]:
        """Return distances of points, (..., 3), from the nearest solid, (...,), m, and their gradients, (..., 3)."""
        distances, normals = (
            np.array(part) for part in zip(*(s.from_points(r_I) for s in self.solids), strict=True)
        )
        nearest = np.argmin(distances, axis=0)[None]
        return distances.min(axis=0), np.take_along_axis(normals, nearest[..., None], axis=0)[0]

    def margins(self, N: int) -> Array:
        """Return the smallest distances of the bodies of N UAVs in the order of `clearances`, (2 N + 1,), m."""
        return np.repeat([self.margin_m, self.load_margin_m], [N, N + 1])


def bodies(N: int) -> list[str]:
    """Return the names of the bodies in the order of `clearances`: UAVs, rods, payload."""
    return [f"{what}{i}" for what in ("UAV", "rod ") for i in range(1, N + 1)] + ["payload"]


def clearances(system: System, obstacle: Obstacle, x: Array) -> Array:
    """Return distances of UAV centres, rods and payload from an obstacle at states, (k, n).

    (k, 2 N + 1), m: (69a).
    """
    view, R = state.StateView(x), np.array([rotation(Theta) for Theta in x[:, state.THETA0]])
    rho, lengths = (
        np.array([getattr(uav, key) for uav in system.uavs]) for key in ("rho", "rod_length")
    )
    low = view.r0_I[:, None] + np.einsum("kij,nj->kni", R, rho)
    high = low - lengths[:, None] * np.einsum("kij,knj->kni", R, view.e_P)
    half = payload_half_size(system)
    found = [
        np.column_stack(
            [s.from_points(high)[0], s.from_segments(low, high), s.from_boxes(view.r0_I, R, half)]
        )
        for s in obstacle.solids
    ]
    return np.asarray(np.min(found, axis=0))


def _apart(a: Array, b: Array, half: Array) -> Array:
    """Return the distances of segments from a box about the origin.

    Zeros of the slope of a convex function.
    """
    along, low, high = b - a, np.zeros(a.shape[:-1]), np.ones(a.shape[:-1])
    for _ in range(_HALVINGS):
        s = (low + high) / 2.0
        p = a + s[..., None] * along
        falls = ((p - np.clip(p, -half, half)) * along).sum(axis=-1) < 0.0
        low, high = np.where(falls, s, low), np.where(falls, high, s)
    p = a + ((low + high) / 2.0)[..., None] * along
    return np.asarray(np.linalg.norm(p - np.clip(p, -half, half), axis=-1))


def _edges(half: Array) -> Array:
    """Return the ends of all edges of a box about the origin, (edges, 2, 3)."""
    signs = np.array(list(product((-1.0, 1.0), repeat=3)))
    pairs = [
        (a, b) for a in signs for b in signs if np.abs(a - b).sum() == 2.0 and a.sum() < b.sum()
    ]
    ends = np.minimum(half, _FAR_M) * np.array(pairs)
    return np.unique(ends.reshape(len(ends), 6) + 0.0, axis=0).reshape(-1, 2, 3)
