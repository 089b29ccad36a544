"""Drawing of a run: lines, meshes and labels in moving frames, which browser, Foxglove and figures show alike.

Bodies are fixed in their frames, so that a browser, which applies the poses of a frame at once but the points of lines
one drawing later, never tears them apart; lines that change lie in frames that move with the team or the payload. All
frames are relative to the inertial one, z down; lengths in m.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from model.arrays import Array
from model.parameters import System, payload_corners, payload_half_size
from protocol.scenario.setup import Setup
from transport.scene.history import LinkState
from transport.scene.scene import Scene, SceneBuilder

Colour = tuple[int, int, int]

# For colour-blind readers (after Okabe and Ito 2008), with different lightness for print in grey. Beyond five UAVs the
# colours repeat with another line style.
UAV_COLOURS = ("#004488", "#C24E00", "#009E73", "#E08BBC", "#7F5F00")
_LINE_STYLES = ("-", "--", ":", "-.")

# Ages of plans and their colours (docs/viewer.md), after that of a fresh one, which is at most `_FRESH_S` old; dark if
# older than the oldest, or without any plan.
_FRESH_S, _AGES_S = 0.1, (0.2, 0.5)
_AGE_COLOURS = ((154, 154, 154), (230, 159, 0), (178, 24, 43))
_OLDEST_S = 1.0
DARK: Colour = (17, 17, 17)


def uav_style(i: int) -> dict[str, Any]:
    """Return line colour and style of UAV i (0-based)."""
    return {
        "color": UAV_COLOURS[i % len(UAV_COLOURS)],
        "linestyle": _LINE_STYLES[i // len(UAV_COLOURS) % len(_LINE_STYLES)],
    }


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


# Layers that can be shown and hidden, and whether they are shown at first; parts of no layer are always shown.
LAYERS: Mapping[str, bool] = {
    "predictions": True,
    "actual paths": True,
    "reference": True,
    "links": True,
    "thrust": True,
    "names": True,
}
INERTIAL, PAYLOAD, TEAM, LOAD, GOAL = "inertial", "payload", "team", "load", "goal"

_PAYLOAD, _ROD, _REFERENCE, _FLOWN = (60, 60, 60), (90, 90, 90), (150, 150, 150), (0, 0, 0)
_CONTACT, _GROUND, _OBSTACLE = (178, 24, 43), (225, 222, 214), (196, 120, 60)
# Arm length, rotor radius, beam and body thickness of a drawn quadrotor, in parts of its span (rotor tip to rotor tip).
_ARM, _ROTOR, _BEAM, _BODY = 0.31, 0.17, 0.02, 0.06
# Its span, m, and at most this part of the smallest gap between UAVs, so that they do not overlap.
_SPAN_M, _SPAN_OF_GAP = 0.9, 0.7
# Thickness of the drawn payload, a plate through the attachments, and its least half width around the centre; length of
# a thrust arrow at hover, and of its head; radius of the reference and of a contact; thickness of the ground, m.
_PLATE_M, _CORE_M = 0.12, 0.15
ARROW_M, _HEAD_M = 0.6, 0.05
_GOAL_M, _CONTACT_M, _GROUND_M = 0.07, 0.03, 0.02
# Distance of the plane below everything where there is no ground, m.
_BELOW_M = 0.5
# Half size from which an obstacle counts as endless, and how far beyond the maneuver it is drawn then, m.
_ENDLESS_M, _BEYOND_M = 1e4, 1.0
# Points of a flown and of a reference path, and tolerance of the former in parts of the maneuver's size: wide lines are
# a third of the work of a browser without a graphics processor.
_POINTS, _POINTS_REFERENCE, _TOLERANCE = 240, 120, 5e-4
# Points of the reference to a target, and targets drawn with so many: the newest ones.
_POINTS_TARGET, _DRAWN_TARGETS = 30, 20
# Dashes of half a link; the gap in each is the share of lost plans. A trace is left at 100 % loss.
_DASHES, _TRACE = 8, 0.15

Pose = tuple[Array, Array]  # position, (3,), and rotation to the inertial frame, (3, 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lines:
    """Segments, (k, 2, 3), in a frame, with their colours, (k, 3), 0..255, and width on the screen, pixels."""

    name: str
    frame: str
    layer: str
    segments: Array
    colours: Array
    width: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mesh:
    """Vertices, (V, 3), in a frame, and triangles, (F, 3), that face outwards."""

    name: str
    frame: str
    vertices: Array
    faces: npt.NDArray[np.int32]
    colour: Colour
    layer: str = ""
    opacity: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Label:
    """Text at a position, (3,), in a frame; it faces the reader."""

    name: str
    frame: str
    text: str
    position: Array
    colour: Colour
    layer: str = "names"


Part = Lines | Mesh | Label


class Drawing:
    """Drawing of one run.

    Attributes:
        fixed: Parts that stay as they are in their frames.
        low, high: Corners of the box around the maneuver, (3,), inertial frame, with the UAVs' arrows and names.
        start_I: Position of the payload at the start of the reference, (3,), inertial frame.
        team_I: Middle of the UAVs at this start, (3,), m.
        size: Diagonal of this box.
        floor: z of the ground, or of a plane below everything, inertial frame.
        span: Span of a drawn quadrotor.
    """

    def __init__(self, builder: SceneBuilder) -> None:
        self._builder, self._setup = builder, builder.setup
        self._N = self._setup.system.N
        payload_I, uavs_I = self._reference()
        self.start_I, self.team_I = payload_I[0], uavs_I[0].mean(axis=0)
        above = uavs_I.reshape(-1, 3) - np.array([0.0, 0.0, 2.0 * ARROW_M])
        everything = np.vstack([payload_I, above])
        self.low, self.high = everything.min(axis=0), everything.max(axis=0)
        self.size = float(np.linalg.norm(self.high - self.low))
        self._ground_m = self._setup.scenario.plant.ground_m
        self.floor = float(self.high[2]) + _BELOW_M if self._ground_m is None else self._ground_m
        self.span = min([uav_span(builder.start_I), *(2.0 * obstacle.margin_m for obstacle in self._setup.obstacles)])
        self._targets = len(self._setup.maneuver.targets)  # that are drawn
        self.fixed: tuple[Part, ...] = tuple(self._fixed())

    def _reference(self) -> tuple[Array, Array]:
        """Return the reference paths of payload, (k, 3), and UAVs, (k, N, 3), inertial frame, m."""
        setup = self._builder.setup
        times_s = np.linspace(0.0, setup.ticks * setup.settings.sampling_period_s, _POINTS_REFERENCE)
        legs = [np.linspace(target.since_s, target.ends_s, _POINTS_TARGET) for target in setup.maneuver.targets]
        times_s = np.unique(np.concatenate([times_s, *legs[-_DRAWN_TARGETS:]])) if legs else times_s
        uavs_I = setup.reference.outputs(times_s)[:, : 3 * self._N].reshape(-1, self._N, 3)
        return setup.maneuver.path(times_s)[0], uavs_I

    def _reference_lines(self) -> Iterator[Lines]:
        payload_I, uavs_I = self._reference()
        for name, path, width in (
            ("payload", payload_I, 1.5),
            *((f"uav{i + 1}", uavs_I[:, i], 1.0) for i in range(self._N)),
        ):
            dashes = segments(path)[::2]
            colours = _colours([_REFERENCE] * len(dashes))
            layer, name_ = "reference", f"reference of {name}"
            yield Lines(name=name_, frame=INERTIAL, layer=layer, segments=dashes, colours=colours, width=width)

    def poses(self, scene: Scene) -> dict[str, Pose]:
        """Return the pose of every frame in a scene; parts in other frames are not to be seen in it."""
        level = np.eye(3)
        poses: dict[str, Pose] = {
            INERTIAL: (np.zeros(3), level),
            PAYLOAD: (scene.payload_I, scene.R_payload),
            TEAM: (scene.uavs_I.mean(axis=0), level),
            LOAD: (scene.payload_I, level),
            GOAL: (scene.payload_reference_I, level),
        }
        for i in range(self._N):
            if i + 1 not in scene.released:
                poses[f"uav{i + 1}"] = scene.uavs_I[i], scene.R_uavs[i]
                rod_I = scene.uavs_I[i] - scene.attachments_I[i]
                poses[f"rod{i + 1}"] = scene.attachments_I[i], rotation_from_up(rod_I)
        poses.update({f"contact{k + 1}": (corner_I, level) for k, corner_I in enumerate(scene.contacts_I)})
        return poses

    def moving(self, scene: Scene, *, flown: bool = True) -> Iterator[Lines]:
        """Yield the lines of a scene, the same names for each; with `flown` the actual paths too.

        A new target also changes the lines of the reference among the fixed parts, once.
        """
        targets = len(self._builder.setup.maneuver.targets)
        if targets != self._targets:
            self._targets, self.fixed = targets, tuple(self._fixed())
            if self._ground_m is None:
                self.floor = max(self.floor, float(self._reference()[0][:, 2].max()) + _BELOW_M)
            yield from self._reference_lines()
        yield self._thrust(scene)
        team_I, owned = scene.uavs_I.mean(axis=0), self._setup.owned
        positions = np.array([scene.uavs_I[list(uavs)].mean(axis=0) for uavs in owned]) - team_I
        pieces, colours = link_segments(scene.links, positions, self._setup.settings.sampling_period_s)
        yield Lines(name="links", frame=TEAM, layer="links", segments=pieces, colours=colours, width=5.0)
        uavs, payload = [], []
        for prediction in scene.predictions:
            own = owned[prediction.agent - 1]
            uavs += [(uav_colour(uav), prediction.uavs_I[:, k] - team_I) for k, uav in enumerate(own)]
            payload.append((uav_colour(own[0]), prediction.payload_I - scene.payload_I))
        yield _paths("predicted UAVs", TEAM, "predictions", uavs, 4.0)
        yield _paths("predicted payload", LOAD, "predictions", payload, 4.0)
        if flown:
            yield self.flown(scene)

    def flown(self, scene: Scene) -> Lines:
        """Return the actual paths until a scene."""
        payload_I, uavs_I = self._builder.paths(scene.tick, _POINTS)
        paths = [(_FLOWN, payload_I), *((uav_colour(i), uavs_I[:, i]) for i in range(self._N))]
        near = _TOLERANCE * self.size
        paths = [(colour, simplified(path, near)) for colour, path in paths]
        return _paths("actual paths", INERTIAL, "actual paths", paths, 2.0)

    def _thrust(self, scene: Scene) -> Lines:
        """Return an arrow for each UAV, whose head has four strokes."""
        arrows, colours = [], []
        for i, (place_I, thrust_I, R) in enumerate(zip(scene.uavs_I, scene.thrusts_I, scene.R_uavs, strict=True)):
            if i + 1 in scene.released:
                continue
            tip_I = place_I + thrust_I * (ARROW_M / self._builder.hover_N)
            barbs = tip_I + _HEAD_M * np.array([[1, 0, 2], [-1, 0, 2], [0, 1, 2], [0, -1, 2]]) @ R.T
            arrows += [(place_I, tip_I), *((tip_I, barb) for barb in barbs)]
            colours += [uav_colour(i)] * 5
        segments = np.array(arrows).reshape(-1, 2, 3) - scene.uavs_I.mean(axis=0)
        return Lines(name="thrust", frame=TEAM, layer="thrust", segments=segments, colours=_colours(colours), width=3.0)

    def _fixed(self) -> Iterator[Part]:
        system = self._setup.system
        yield from self._reference_lines()
        yield _solid("reference position", GOAL, _ball(_GOAL_M), _REFERENCE, layer="reference")
        yield _solid("body", PAYLOAD, payload_points(system, grounded=self._ground_m is not None), _PAYLOAD)
        offsets = name_offsets(self._builder.start_I)
        for i, uav in enumerate(system.uavs):
            rod = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, -uav.rod_length]]])
            yield Lines(name="rod", frame=f"rod{i + 1}", layer="", segments=rod, colours=_colours([_ROD]), width=3.0)
            yield from self._uav(i)
            yield Label(name="name", frame=f"uav{i + 1}", text=f"UAV{i + 1}", position=offsets[i], colour=uav_colour(i))
        yield from obstacles(self._setup, self.low, np.array([*self.high[:2], self.floor]))
        if self._ground_m is not None:
            middle, width = np.round((self.low + self.high)[:2] / 2.0), np.ceil(0.7 * self.size)
            below = self._ground_m + np.array([1.0, 2.0]) * _GROUND_M  # below the grid of the viewer
            ground = np.array([[*(middle + width * np.array(xy)), z] for xy in _SQUARE for z in below])
            yield _solid("ground", INERTIAL, ground, _GROUND)
            for k in range(len(payload_corners(system))):
                yield _solid("contact", f"contact{k + 1}", _ball(_CONTACT_M), _CONTACT)

    def _uav(self, i: int) -> Iterator[Mesh]:
        """Yield body, beams and rotors of a quadrotor; its front rotors are dark."""
        frame, colour, s = f"uav{i + 1}", uav_colour(i), self.span
        yield _solid("hub", frame, s * _disc(2.0 * _BODY, _BODY), colour)
        for k, yaw in enumerate(np.radians([45.0, 135.0])):
            along, aside = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
            beam = [_ARM * x * along + _BEAM * y * aside for x, y in _SQUARE]
            both = np.vstack([beam, beam]) - np.outer([_BODY / 2.0] * 4 + [_BODY / 2.0 + _BEAM] * 4, [0.0, 0.0, 1.0])
            yield _solid(f"beam{k}", frame, s * both, _ROD)
        angles = np.radians([45.0, 135.0, 225.0, 315.0])
        for k, (x, y) in enumerate(_ARM * np.column_stack([np.cos(angles), np.sin(angles)])):
            rotor = s * (_disc(_ROTOR, 0.02) + np.array([x, y, -_BODY]))
            yield _solid(f"rotor{k}", frame, rotor, _PAYLOAD if x > 0.0 else colour, opacity=0.6)


def obstacles(setup: Setup, low: Array, high: Array) -> Iterator[Mesh]:
    """Yield the obstacles; endless ones reach beyond a box with corners low and high, (3,), inertial frame, m."""
    beyond = np.array([_BEYOND_M, _BEYOND_M, 0.0])
    corners = np.array(list(product(*zip(low - beyond, high + beyond, strict=True))))
    for k, solid in enumerate(solid for obstacle in setup.obstacles for solid in obstacle.solids):
        seen, endless = (corners - solid.centre_I) @ solid.R, solid.half > _ENDLESS_M
        near = np.where(endless, np.maximum(seen.min(axis=0), -solid.half), -solid.half)
        far = np.where(endless, np.maximum(np.minimum(seen.max(axis=0), solid.half), near + _GROUND_M), solid.half)
        ends = np.array(list(product(*zip(near, far, strict=True))))
        around = _disc(solid.radius, 0.0) if endless[2] else _ball(solid.radius)
        points = ends[:, None] + (around if solid.radius else np.zeros((1, 3)))
        placed = points.reshape(-1, 3) @ solid.R.T + solid.centre_I
        yield _solid(f"obstacle{k + 1}", INERTIAL, placed, _OBSTACLE, opacity=0.4)


_SQUARE = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))


def payload_points(system: System, *, grounded: bool = False) -> Array:
    """Return the corners of a plate with all attachments on its top, (V, 3), payload frame.

    Where there is a ground, the plate is as thick as the box that touches it.
    """
    flat = np.vstack([[uav.rho[:2] for uav in system.uavs], _CORE_M * np.array(_SQUARE)])
    height = float(np.mean([uav.rho[2] for uav in system.uavs]))
    bottom = float(payload_half_size(system)[2]) if grounded else height + _PLATE_M
    return np.vstack([np.column_stack([flat, np.full(len(flat), z)]) for z in (height, bottom)])


def hull(points: Array) -> npt.NDArray[np.int32]:
    """Return the triangles, (F, 3), of the convex hull of points, (V, 3), so that they face outwards."""
    found = ConvexHull(points)
    triangles: npt.NDArray[np.int32] = found.simplices.copy()
    for triangle, normal in zip(triangles, found.equations[:, :3], strict=True):
        a, b, c = points[triangle]
        if np.cross(b - a, c - a) @ normal < 0.0:
            triangle[1:] = triangle[2:0:-1].copy()
    return triangles


def uav_span(positions: Array) -> float:
    """Return the span of drawn UAVs that hover at positions, (N, 3)."""
    gaps = [float(np.linalg.norm(a - b)) for i, a in enumerate(positions) for b in positions[:i]]
    return min([_SPAN_M, *(_SPAN_OF_GAP * gap for gap in gaps)])


def name_offsets(positions: Array) -> Array:
    """Return where the names of UAVs at positions, (N, 3), stand relative to them, (N, 3): outside the formation."""
    outwards = positions - positions.mean(axis=0)
    distances = np.linalg.norm(outwards, axis=1, keepdims=True)
    offsets: Array = 0.3 * outwards / np.maximum(distances, 1e-6) + np.array([0.0, 0.0, -0.1])
    return offsets


def rotation_from_up(direction: Array) -> Array:
    """Return the shortest rotation, (3, 3), from up (-z) to a direction, (3,)."""
    x, y, z = direction / np.linalg.norm(direction)
    if z > 1.0 - 1e-9:  # straight down
        return np.diag([1.0, -1.0, -1.0])
    turn = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])  # of axis (-z) x direction, angle's sine
    R: Array = np.eye(3) + turn + turn @ turn / (1.0 - z)
    return R


def quaternion(R: Array) -> Array:
    """Return the quaternion (w, x, y, z) of a rotation matrix, (4,)."""
    return np.asarray(np.roll(Rotation.from_matrix(R).as_quat(), 1))


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


def link_segments(links: Sequence[LinkState], positions: Array, period_s: float) -> tuple[Array, Array]:
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
        drawn = max(1.0 - link.loss, _TRACE)
        dashes = _DASHES if link.loss else 1
        for k in range(dashes):
            start, end = ((k + 0.5 + side * drawn / 2.0) / dashes / 2.0 for side in (-1.0, 1.0))
            pieces.append(np.array([near + start * (far - near), near + end * (far - near)]))
            colours.append(age_colour(link.age_s, period_s))
    return np.array(pieces).reshape(-1, 2, 3), _colours(colours)


def _paths(name: str, frame: str, layer: str, paths: Sequence[tuple[Colour, Array]], width: float) -> Lines:
    """Return paths, (k, 3), each in its colour."""
    pieces = [segments(path) for _, path in paths]
    colours = [colour for (colour, _), piece in zip(paths, pieces, strict=True) for _ in piece]
    together = np.concatenate([np.zeros((0, 2, 3)), *pieces])
    return Lines(name=name, frame=frame, layer=layer, segments=together, colours=_colours(colours), width=width)


def _colours(colours: Sequence[Colour]) -> Array:
    return np.array(colours, dtype=float).reshape(-1, 3)


def _solid(name: str, frame: str, points: Array, colour: Colour, *, layer: str = "", opacity: float = 1.0) -> Mesh:
    return Mesh(
        name=name, frame=frame, vertices=points, faces=hull(points), colour=colour, layer=layer, opacity=opacity
    )


def _ball(radius: float) -> Array:
    """Return points of a sphere, (18, 3)."""
    grid = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if abs(x) + abs(y) + abs(z)])
    points: Array = radius * grid / np.linalg.norm(grid, axis=1, keepdims=True)
    return points


def _disc(radius: float, height: float) -> Array:
    """Return points of a flat cylinder about the origin, (2 k, 3)."""
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    ring = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.vstack([np.column_stack([ring, np.full(len(ring), z)]) for z in (-height / 2.0, height / 2.0)])
