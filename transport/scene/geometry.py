"""Shapes and colours of what is seen, in the inertial frame with z down; no library that draws is known here."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from model.arrays import Array
from model.parameters import System
from transport.scene.colours import uav_style
from transport.scene.link_history import LinkState
from transport.scene.scene import Scene

Colour = tuple[int, int, int]

# A quadrotor to look at, in parts of its span from rotor tip to rotor tip.
ARM, ROTOR, BEAM, BODY = 0.31, 0.17, 0.02, 0.06
# Its span, m: as large as a real one, and small enough that a team does not overlap.
_SPAN_M, _SPAN_OF_GAP = 0.9, 0.7
# The payload is a plate through the attachments, this thick, m, with at least this much around its centre, m.
_PLATE_M, _CORE_M = 0.12, 0.15

# From as fresh as can be to half a second old, as in docs/viewer.md; black beyond all and where nothing was heard.
_AGES_S = (0.0, 0.2, 0.5)
_AGE_COLOURS = ((154, 154, 154), (230, 159, 0), (178, 24, 43))
_OLDEST_S = 1.0
DARK: Colour = (17, 17, 17)

# Pieces of half a link: as much of each is left out as is lost.
_DASHES = 8


def uav_colour(i: int) -> Colour:
    """Of UAV i (0-based), as in the figures."""
    code = uav_style(i)["color"].lstrip("#")
    return int(code[:2], 16), int(code[2:4], 16), int(code[4:], 16)


def age_colour(age_s: float | None) -> Colour:
    """Of a link whose newest plan is that old."""
    if age_s is None or age_s > _OLDEST_S:
        return DARK
    channels = zip(*_AGE_COLOURS, strict=True)
    r, g, b = (round(float(np.interp(age_s, _AGES_S, channel))) for channel in channels)
    return r, g, b


def quaternion(R: Array) -> Array:
    """Quaternion (w, x, y, z) of a rotation matrix, (4,), or of several, (k, 4)."""
    xyzw = Rotation.from_matrix(R).as_quat()
    return np.asarray(np.roll(xyzw, 1, axis=-1))


def payload_mesh(system: System) -> tuple[Array, Array]:
    """Vertices (V, 3), payload frame, m, and triangles (F, 3) of a plate that all rods can be fixed to."""
    core = _CORE_M * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    flat = np.vstack([[uav.rho[:2] for uav in system.uavs], core])
    height = float(np.mean([uav.rho[2] for uav in system.uavs]))
    # The rods end on its upper face, and up is -z.
    points = np.vstack([np.column_stack([flat, np.full(len(flat), height + z)]) for z in (0.0, _PLATE_M)])
    hull = ConvexHull(points)
    triangles = hull.simplices.copy()
    for triangle, normal in zip(triangles, hull.equations[:, :3], strict=True):
        a, b, c = points[triangle]
        if np.cross(b - a, c - a) @ normal < 0.0:
            triangle[1:] = triangle[2:0:-1].copy()
    return points, triangles


def span_m(places_I: Array) -> float:
    """How large UAVs are drawn that hover at these places, (N, 3), m."""
    gaps = [float(np.linalg.norm(a - b)) for i, a in enumerate(places_I) for b in places_I[:i]]
    return min([_SPAN_M, *(_SPAN_OF_GAP * gap for gap in gaps)])


def rotor_centres() -> Array:
    """Rotors of a quadrotor of span 1, (4, 3), body frame: slightly above its centre, which is at -z."""
    angles = np.radians([45.0, 135.0, 225.0, 315.0])
    return np.column_stack([ARM * np.cos(angles), ARM * np.sin(angles), np.full(4, -BODY)])


def name_places(scene: Scene) -> Array:
    """Where the UAVs' names stand, (N, 3), inertial frame, m: outside the ring they make, where there is room."""
    outwards = scene.uavs_I - scene.uavs_I.mean(axis=0)
    distances = np.linalg.norm(outwards, axis=1, keepdims=True)
    places: Array = scene.uavs_I + 0.3 * outwards / np.maximum(distances, 1e-6) + np.array([0.0, 0.0, -0.1])
    return places


def dashed(path: Array, on: int = 1, off: int = 1) -> Array:
    """Segments of a path with gaps, (k, 2, 3)."""
    pieces = segments(path)
    return pieces[np.arange(len(pieces)) % (on + off) < on]


def simplified(path: Array, tolerance_m: float) -> Array:
    """A path, (k, 3), without points that it can do without: what is left is as far from it as the tolerance, about.

    Every second point goes that is as near to the line between its neighbours, and so on until none goes: straight
    pieces, of which maneuvers are made, take two points.
    """
    while True:
        before, middle, after = path[:-2:2], path[1:-1:2], path[2::2]
        along = after - before
        squared = np.maximum(np.einsum("ij,ij->i", along, along), 1e-12)
        share = np.clip(np.einsum("ij,ij->i", middle - before, along) / squared, 0.0, 1.0)
        near = np.linalg.norm(middle - before - share[:, None] * along, axis=1) <= tolerance_m
        if not near.any():
            return path
        path = np.delete(path, 1 + 2 * np.flatnonzero(near), axis=0)


def segments(path: Array) -> Array:
    """Segments of a path, (k, 2, 3), from its points, (k + 1, 3)."""
    return np.stack([path[:-1], path[1:]], axis=1) if len(path) > 1 else np.zeros((0, 2, 3))


def agent_places(scene: Scene, owned: Sequence[Sequence[int]]) -> Array:
    """Where each agent is drawn: amid its UAVs, (agents, 3), inertial frame, m."""
    return np.array([scene.uavs_I[list(uavs)].mean(axis=0) for uavs in owned])


def link_segments(links: Sequence[LinkState], places: Array) -> tuple[Array, npt.NDArray[np.uint8]]:
    """The links as dashes: the half next to a receiver is its own link, as much of it left out as is lost.

    Args:
        links: Of a scene.
        places: Of the agents, (agents, 3), m.
    Returns: Segments (k, 2, 3), m, and their colours (k, 3), 0..255.
    """
    pieces: list[Array] = []
    colours: list[Colour] = []
    for link in links:
        near, far = places[link.receiver - 1], places[link.sender - 1]
        drawn = max(1.0 - link.loss, 0.15)  # of one that loses everything a trace is left
        dashes = _DASHES if link.loss else 1
        for k in range(dashes):
            start = (k + 0.5 - drawn / 2.0) / dashes / 2.0
            end = (k + 0.5 + drawn / 2.0) / dashes / 2.0
            pieces.append(np.array([near + start * (far - near), near + end * (far - near)]))
            colours.append(age_colour(link.age_s))
    return np.array(pieces).reshape(-1, 2, 3), np.array(colours, dtype=np.uint8).reshape(-1, 3)
