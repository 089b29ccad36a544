"""Shapes and colours of payload, UAVs, paths and links, in the inertial frame with z down."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from model.arrays import Array
from model.parameters import System
from model.shape import payload_half_size
from transport.scene.colours import uav_style
from transport.scene.link_history import LinkState
from transport.scene.scene import Scene

Colour = tuple[int, int, int]

# Arm length, rotor radius, beam and body thickness of a drawn quadrotor, in parts of its span (rotor tip to rotor tip).
ARM, ROTOR, BEAM, BODY = 0.31, 0.17, 0.02, 0.06
# Its span, m, and at most this part of the smallest gap between UAVs, so that they do not overlap.
_SPAN_M, _SPAN_OF_GAP = 0.9, 0.7
# Thickness of the drawn payload, a plate through the attachments, and its least half width around the centre, m.
_PLATE_M, _CORE_M = 0.12, 0.15

# Ages of plans and their colours (docs/viewer.md), after that of a fresh one, which is at most `_FRESH_S` old; dark if
# older than the oldest, or without any plan.
_FRESH_S, _AGES_S = 0.1, (0.2, 0.5)
_AGE_COLOURS = ((154, 154, 154), (230, 159, 0), (178, 24, 43))
_OLDEST_S = 1.0
DARK: Colour = (17, 17, 17)

# Dashes of half a link; the gap in each is the share of lost plans.
_DASHES = 8


def uav_colour(i: int) -> Colour:
    """Return the colour of UAV i (0-based), 0..255."""
    code = uav_style(i)["color"].lstrip("#")
    return int(code[:2], 16), int(code[2:4], 16), int(code[4:], 16)


def age_colour(age_s: float | None, period_s: float) -> Colour:
    """Return the colour of a link by the age of the newest plan, s; None for no plan.

    A plan that is one sampling period old is fresh: on a perfect network there is no newer one.
    """
    if age_s is None or age_s > _OLDEST_S:
        return DARK
    channels = zip(*_AGE_COLOURS, strict=True)
    r, g, b = (round(float(np.interp(age_s, (min(period_s, _FRESH_S), *_AGES_S), channel))) for channel in channels)
    return r, g, b


def quaternion(R: Array) -> Array:
    """Return the quaternion (w, x, y, z) of a rotation matrix, (4,), or of several, (k, 4)."""
    xyzw = Rotation.from_matrix(R).as_quat()
    return np.asarray(np.roll(xyzw, 1, axis=-1))


def quaternion_from_up(direction: Array) -> Array:
    """Return the quaternion (w, x, y, z) of the shortest rotation from up (-z) to a direction, (3,)."""
    x, y, z = direction / np.linalg.norm(direction)
    q = np.array([1.0 - z, y, -x, 0.0])  # half-way rotation: (1 + a.b, a x b) of a = -z, b = direction
    size = np.linalg.norm(q)
    return q / size if size > 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])


def payload_mesh(system: System, *, grounded: bool = False) -> tuple[Array, Array]:
    """Return vertices (V, 3), payload frame, m, and triangles (F, 3) of a plate with all attachments on its top.

    Where there is a ground, the plate is as thick as the box that touches it.
    """
    core = _CORE_M * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    flat = np.vstack([[uav.rho[:2] for uav in system.uavs], core])
    height = float(np.mean([uav.rho[2] for uav in system.uavs]))
    bottom = float(payload_half_size(system)[2]) if grounded else height + _PLATE_M
    points = np.vstack([np.column_stack([flat, np.full(len(flat), z)]) for z in (height, bottom)])
    hull = ConvexHull(points)
    triangles = hull.simplices.copy()
    for triangle, normal in zip(triangles, hull.equations[:, :3], strict=True):
        a, b, c = points[triangle]
        if np.cross(b - a, c - a) @ normal < 0.0:
            triangle[1:] = triangle[2:0:-1].copy()
    return points, triangles


def uav_span(positions: Array) -> float:
    """Return the span, m, of drawn UAVs that hover at positions, (N, 3), m."""
    gaps = [float(np.linalg.norm(a - b)) for i, a in enumerate(positions) for b in positions[:i]]
    return min([_SPAN_M, *(_SPAN_OF_GAP * gap for gap in gaps)])


def rotor_centres() -> Array:
    """Return the rotor centres of a quadrotor of span 1, (4, 3), body frame (z down)."""
    angles = np.radians([45.0, 135.0, 225.0, 315.0])
    return np.column_stack([ARM * np.cos(angles), ARM * np.sin(angles), np.full(4, -BODY)])


def name_offsets(positions: Array) -> Array:
    """Return where the names of UAVs at positions, (N, 3), stand relative to them, (N, 3), m: outside the formation."""
    outwards = positions - positions.mean(axis=0)
    distances = np.linalg.norm(outwards, axis=1, keepdims=True)
    offsets: Array = 0.3 * outwards / np.maximum(distances, 1e-6) + np.array([0.0, 0.0, -0.1])
    return offsets


def simplified(path: Array, tolerance_m: float) -> Array:
    """Return a path, (k, 3), with fewer points, about as near to the original as the tolerance.

    Every second point that is near enough to the line between its neighbours is removed, until none is.
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
    """Return the segments of a path, (k, 2, 3), from its points, (k + 1, 3)."""
    return np.stack([path[:-1], path[1:]], axis=1) if len(path) > 1 else np.zeros((0, 2, 3))


def agent_positions(scene: Scene, owned: Sequence[Sequence[int]]) -> Array:
    """Return the mean position of each agent's UAVs, (agents, 3), inertial frame, m."""
    return np.array([scene.uavs_I[list(uavs)].mean(axis=0) for uavs in owned])


def link_segments(links: Sequence[LinkState], positions: Array, period_s: float) -> tuple[Array, npt.NDArray[np.uint8]]:
    """Return the links as dashed lines: the half next to the receiver, with gaps by packet loss.

    Args:
        links: Links of a scene.
        positions: Positions of the agents, (agents, 3), m.
        period_s: Sampling period, s.
    Returns: Segments (k, 2, 3), m, and their colours (k, 3), 0..255.
    """
    pieces: list[Array] = []
    colours: list[Colour] = []
    for link in links:
        near, far = positions[link.receiver - 1], positions[link.sender - 1]
        drawn = max(1.0 - link.loss, 0.15)  # a trace is left at 100 % loss
        dashes = _DASHES if link.loss else 1
        for k in range(dashes):
            start = (k + 0.5 - drawn / 2.0) / dashes / 2.0
            end = (k + 0.5 + drawn / 2.0) / dashes / 2.0
            pieces.append(np.array([near + start * (far - near), near + end * (far - near)]))
            colours.append(age_colour(link.age_s, period_s))
    return np.array(pieces).reshape(-1, 2, 3), np.array(colours, dtype=np.uint8).reshape(-1, 3)
