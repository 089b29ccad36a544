"""Drawing of a run: lines, meshes and labels in moving frames, which browser, Foxglove and figures show alike.

Bodies are fixed in their frames; lines that change lie in frames that move with the team or the
payload, as a browser draws their points later than poses. All frames are relative to the inertial
one, z down; lengths in m.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from transport.model.arrays import Array
from transport.model.parameters import System, payload_half_size
from transport.model.rotations import rotation
from transport.model.state import StateView
from transport.protocol.scenario.setup import Setup
from transport.scene.scene import Scene, SceneBuilder

Colour = tuple[int, int, int]
Pose = tuple[Array, Array]  # position, (3,), and rotation to the inertial frame, (3, 3)

# For colour-blind readers and print in grey (after Okabe and Ito 2008), repeated with other line
# styles.
UAV_COLOURS = ("#004488", "#C24E00", "#009E73", "#E08BBC", "#7F5F00")
_LINE_STYLES = ("-", "--", ":", "-.")
# Ages of plans and their colours (docs/viewer.md), that of a fresh one first; dark if older, or
# without any plan.
_FRESH_S, _AGES_S, _OLDEST_S = 0.1, (0.2, 0.5), 1.0
_AGE_COLOURS = ((154, 154, 154), (230, 159, 0), (178, 24, 43))
DARK: Colour = (17, 17, 17)

# Layers that can be shown and hidden; parts of no layer are always shown.
LAYERS = ("predictions", "actual paths", "reference", "links", "thrust", "names")
INERTIAL, PAYLOAD, TEAM, LOAD, GOAL = "inertial", "payload", "team", "load", "goal"
# Foxglove and ROS 2 draw z up: the inertial frame, z down, is this frame turned about x.
ROOT = "map"
UPSIDE_DOWN: Pose = (np.zeros(3), np.diag([1.0, -1.0, -1.0]))

_PAYLOAD, _ROD, _REFERENCE, _FLOWN = (60, 60, 60), (90, 90, 90), (150, 150, 150), (0, 0, 0)
_OBSTACLE = (196, 120, 60)
# Of a UAV whose agent is not on the roster.
OFF_COLOUR: Colour = (170, 170, 170)
# Arm length, rotor radius, beam and body thickness of a drawn quadrotor, in parts of its span
# (rotor tip to rotor tip).
_ARM, _ROTOR, _BEAM, _BODY = 0.31, 0.17, 0.02, 0.06
_SPAN_M, _SPAN_OF_GAP = (
    0.9,
    0.7,
)  # its span, m, and at most this part of the smallest gap between UAVs
_PLATE_M, _CORE_M = 0.12, 0.15  # thickness of the drawn payload, and its least half width, m
ARROW_M, _HEAD_M = 0.6, 0.05  # length of a thrust arrow at hover, and of its head, m
_GOAL_M, _THIN_M = 0.07, 0.02  # radius of the reference, and least size of an obstacle, m
_BELOW_M = 0.5  # distance of the plane below everything where there is no ground, m
_ENDLESS_M, _BEYOND_M = (
    1e4,
    1.0,
)  # half size of an endless obstacle, and how far beyond the maneuver it is drawn, m
_POINTS, _POINTS_REFERENCE = 160, 120  # of a flown and of a reference path
_POINTS_TARGET, _DRAWN_TARGETS = (
    30,
    20,
)  # points of the reference to a target, and targets drawn with them
_SQUARE = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])


class Lines(NamedTuple):
    """Segments, (k, 2, 3), in a frame, with their colours, (k, 3), 0..255, and width on the screen, pixels."""

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


Part = Lines | Mesh | Label


class Drawing:
    """Drawing of one run: parts that stay as they are in their frames, `fixed`, and those of a scene."""

    def __init__(self, builder: SceneBuilder) -> None:
        self._builder, self._setup = builder, builder.setup
        self._N = self._setup.system.N
        payload_I, uavs_I = self._reference()
        # Start of payload and of the middle of the UAVs, (3,); box around the maneuver and arrows;
        # its diagonal.
        self.start_I, self.team_I = payload_I[0], uavs_I[0].mean(axis=0)
        everything = np.vstack(
            [payload_I, uavs_I.reshape(-1, 3) - np.array([0.0, 0.0, 2.0 * ARROW_M])]
        )
        self.low, self.high = everything.min(axis=0), everything.max(axis=0)
        self.size = float(np.linalg.norm(self.high - self.low))
        ground_m = self._setup.scenario.plant.ground_m
        self.floor = float(self.high[2]) + _BELOW_M if ground_m is None else ground_m
        gap_m = pdist(builder.start_I).min(initial=np.inf)
        margins_m = [2.0 * obstacle.margin_m for obstacle in self._setup.obstacles]
        self.span = min([_SPAN_M, _SPAN_OF_GAP * float(gap_m), *margins_m])
        self._targets = len(self._setup.maneuver.targets)  # that are drawn
        self.fixed: tuple[Part, ...] = tuple(self._fixed())

    def _reference(self) -> tuple[Array, Array]:
        """Return the reference paths of payload, (k, 3), and UAVs, (k, N, 3), inertial frame, m."""
        setup = self._builder.setup
        times_s = [
            np.linspace(0.0, setup.ticks * setup.settings.sampling_period_s, _POINTS_REFERENCE)
        ]
        for target in setup.maneuver.targets[-_DRAWN_TARGETS:]:
            times_s.append(np.linspace(target.since_s, target.ends_s, _POINTS_TARGET))
        t = np.unique(np.concatenate(times_s))
        return setup.maneuver.path(t)[0], setup.reference.outputs(t)[:, : 3 * self._N].reshape(
            -1, self._N, 3
        )

    def _reference_lines(self) -> Iterator[Lines]:
        payload_I, uavs_I = self._reference()
        paths = {"payload": payload_I, **{f"uav{i + 1}": uavs_I[:, i] for i in range(self._N)}}
        for name, path in paths.items():
            dashes = [(_REFERENCE, _segments(path)[::2])]
            yield _lines(
                f"reference of {name}",
                INERTIAL,
                "reference",
                1.5 if name == PAYLOAD else 1.0,
                dashes,
            )

    def poses(self, scene: Scene) -> dict[str, Pose]:
        """Return the pose of every frame in a scene.

        Parts in other frames are not to be seen in it.
        """
        poses = self._team_poses(
            (scene.payload_I, scene.R_payload),
            list(zip(scene.uavs_I, scene.R_uavs, strict=True)),
            scene.attachments_I,
        )
        for uav in scene.released:
            del poses[f"uav{uav}"], poses[f"rod{uav}"]
        return poses | {GOAL: (scene.payload_reference_I, np.eye(3))}

    def poses_at_start(self) -> dict[str, Pose]:
        """Return the poses of the frames in the initial state, before a run has its first tick."""
        x = self._setup.initial_state()
        view = StateView(x)
        R_payload = rotation(view.Theta0)
        uavs_I = self._setup.model.outputs(x)[: 3 * self._N].reshape(-1, 3)
        R_uavs = [rotation(Theta) for Theta in view.Theta]
        attachments_I = np.array(
            [view.r0_I + R_payload @ uav.rho for uav in self._setup.system.uavs]
        )
        return self._team_poses(
            (view.r0_I, R_payload), list(zip(uavs_I, R_uavs, strict=True)), attachments_I
        )

    def _team_poses(
        self, payload: Pose, uavs: Sequence[Pose], attachments_I: Array
    ) -> dict[str, Pose]:
        """Return the poses of the frames of payload, UAVs and rods, and of those that move along."""
        level = np.eye(3)
        middle_I = np.mean([position_I for position_I, _ in uavs], axis=0)
        poses: dict[str, Pose] = {
            INERTIAL: (np.zeros(3), level),
            PAYLOAD: payload,
            TEAM: (middle_I, level),
            LOAD: (payload[0], level),
        }
        for i, (pose, attachment_I) in enumerate(zip(uavs, attachments_I, strict=True), start=1):
            rod_I = pose[0] - attachment_I
            turn, _ = Rotation.align_vectors(rod_I[None], [[0.0, 0.0, -1.0]])
            poses[f"uav{i}"] = pose
            poses[f"rod{i}"] = attachment_I, turn.as_matrix()
        return poses

    def frames_off(self, scene: Scene) -> frozenset[str]:
        """Return the frames of the UAVs whose agents are not on the roster in a scene."""
        off = [
            uavs
            for agent, uavs in enumerate(self._setup.owned, start=1)
            if agent not in scene.members
        ]
        return frozenset(f"uav{uav + 1}" for uavs in off for uav in uavs)

    def moving(self, scene: Scene) -> Iterator[Lines]:
        """Yield the lines of a scene but the actual paths, after a new target those of the reference too."""
        targets = len(self._builder.setup.maneuver.targets)
        if targets != self._targets:
            self._targets, self.fixed = targets, tuple(self._fixed())
            yield from self._reference_lines()
        team_I, owned = scene.uavs_I.mean(axis=0), self._setup.owned
        yield _lines("thrust", TEAM, "thrust", 3.0, self._arrows(scene))
        yield _lines("links", TEAM, "links", 5.0, self._links(scene))
        uavs, payload = [], []
        for found in scene.predictions:
            own = owned[found.agent - 1]
            uavs += [
                (uav_colour(uav), _segments(found.uavs_I[:, k] - team_I))
                for k, uav in enumerate(own)
            ]
            payload.append((uav_colour(own[0]), _segments(found.payload_I - scene.payload_I)))
        yield _lines("predicted UAVs", TEAM, "predictions", 4.0, uavs)
        yield _lines("predicted payload", LOAD, "predictions", 4.0, payload)

    def flown(self, scene: Scene) -> Lines:
        """Return the actual paths until a scene."""
        payload_I, uavs_I = self._builder.paths(scene.tick, _POINTS)
        paths = [(_FLOWN, payload_I), *((uav_colour(i), uavs_I[:, i]) for i in range(self._N))]
        drawn = [(colour, _segments(path)) for colour, path in paths]
        return _lines("actual paths", INERTIAL, "actual paths", 2.0, drawn)

    def _arrows(self, scene: Scene) -> Iterator[tuple[Colour, Array]]:
        """Yield the thrust of each UAV as an arrow, whose head has four strokes, in the frame of the team."""
        places = scene.uavs_I - scene.uavs_I.mean(axis=0)
        for i, (place, thrust_I, R) in enumerate(
            zip(places, scene.thrusts_I, scene.R_uavs, strict=True)
        ):
            if i + 1 not in scene.released:
                tip = place + thrust_I * (ARROW_M / self._builder.hover_N)
                barbs = (
                    tip + _HEAD_M * np.array([[1, 0, 2], [-1, 0, 2], [0, 1, 2], [0, -1, 2]]) @ R.T
                )
                yield uav_colour(i), np.array([(place, tip), *((tip, barb) for barb in barbs)])

    def _links(self, scene: Scene) -> Iterator[tuple[Colour, Array]]:
        """Yield the links in the frame of the team: the half next to the receiver."""
        positions = np.array([scene.uavs_I[list(uavs)].mean(axis=0) for uavs in self._setup.owned])
        positions -= scene.uavs_I.mean(axis=0)
        for sender, receiver, age_s in scene.links:
            near, far = positions[receiver - 1], positions[sender - 1]
            colour = age_colour(age_s, self._setup.settings.sampling_period_s)
            yield colour, np.array([(near, (near + far) / 2.0)])

    def _fixed(self) -> Iterator[Part]:
        system, start_I = self._setup.system, self._builder.start_I
        grounded = self._setup.scenario.plant.ground_m is not None
        yield from self._reference_lines()
        yield _solid("reference position", GOAL, _ball(_GOAL_M), _REFERENCE, layer="reference")
        yield _solid("body", PAYLOAD, payload_points(system, grounded=grounded), _PAYLOAD)
        outwards = start_I - start_I.mean(axis=0)  # where names stand: outside the formation
        outwards *= 0.3 / np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-6)
        for i, uav in enumerate(system.uavs):
            rod = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, -uav.rod_length]]])
            yield _lines("rod", f"rod{i + 1}", "", 3.0, [(_ROD, rod)])
            yield from self._uav(f"uav{i + 1}", uav_colour(i))
            place = outwards[i] - np.array([0.0, 0.0, 0.1])
            yield Label("name", f"uav{i + 1}", "names", f"UAV{i + 1}", place, uav_colour(i))
        yield from obstacles(self._setup, self.low, np.array([*self.high[:2], self.floor]))

    def _uav(self, frame: str, colour: Colour) -> Iterator[Mesh]:
        """Yield body, beams and rotors of a quadrotor; its front rotors are dark."""
        angles, s = np.radians([45.0, 135.0, 225.0, 315.0]), self.span
        arms = np.column_stack([np.cos(angles), np.sin(angles)])
        yield _solid("hub", frame, s * _disc(2.0 * _BODY, -_BODY / 2.0, _BODY / 2.0), colour)
        for k in range(2):
            beam = (_SQUARE * (_ARM, _BEAM)) @ arms[k : k + 2]
            yield _solid(
                f"beam{k}", frame, s * _prism(beam, -_BODY / 2.0, -_BODY / 2.0 - _BEAM), _ROD
            )
        for k, (x, y) in enumerate(_ARM * arms):
            rotor = s * (_disc(_ROTOR, -0.01, 0.01) + np.array([x, y, -_BODY]))
            yield _solid(f"rotor{k}", frame, rotor, _PAYLOAD if x > 0.0 else colour, opacity=0.6)


def uav_style(i: int) -> dict[str, Any]:
    """Return line colour and style of UAV i (0-based)."""
    cycle, colour = divmod(i, len(UAV_COLOURS))
    return {"color": UAV_COLOURS[colour], "linestyle": _LINE_STYLES[cycle % len(_LINE_STYLES)]}


def uav_colour(i: int) -> Colour:
    """Return the colour of UAV i (0-based), 0..255."""
    r, g, b = bytes.fromhex(uav_style(i)["color"].lstrip("#"))
    return r, g, b


def age_colour(age_s: float | None, period_s: float) -> Colour:
    """Return the colour of a link by the age of the newest plan, s, fresh until one period.

    None for no plan.
    """
    if age_s is None or age_s > _OLDEST_S:
        return DARK
    ages_s = min(period_s, _FRESH_S), *_AGES_S
    r, g, b = (
        round(float(np.interp(age_s, ages_s, channel)))
        for channel in zip(*_AGE_COLOURS, strict=True)
    )
    return r, g, b


def obstacles(setup: Setup, low: Array, high: Array) -> Iterator[Mesh]:
    """Yield the obstacles; endless ones reach beyond a box with corners low and high, (3,), inertial frame, m."""
    beyond = np.array([_BEYOND_M, _BEYOND_M, 0.0])
    corners = np.array(list(product(*zip(low - beyond, high + beyond, strict=True))))
    for k, solid in enumerate(solid for obstacle in setup.obstacles for solid in obstacle.solids):
        seen, endless = (corners - solid.centre_I) @ solid.R, solid.half > _ENDLESS_M
        near = np.where(endless, np.maximum(seen.min(axis=0), -solid.half), -solid.half)
        far = np.where(
            endless,
            np.maximum(np.minimum(seen.max(axis=0), solid.half), near + _THIN_M),
            solid.half,
        )
        ends = np.array(list(product(*zip(near, far, strict=True))))
        around = _disc(solid.radius, 0.0) if endless[2] else _ball(solid.radius)
        points = ends[:, None] + (around if solid.radius else np.zeros((1, 3)))
        placed = points.reshape(-1, 3) @ solid.R.T + solid.centre_I
        yield _solid(f"obstacle{k + 1}", INERTIAL, placed, _OBSTACLE, opacity=0.4)


def payload_points(system: System, *, grounded: bool = False) -> Array:
    """Return the corners of a plate below all attachments, (V, 3), payload frame.

    On a ground it is the box there.
    """
    flat = np.vstack([[uav.rho[:2] for uav in system.uavs], _CORE_M * _SQUARE])
    height = float(np.mean([uav.rho[2] for uav in system.uavs]))
    return _prism(
        flat, height, float(payload_half_size(system)[2]) if grounded else height + _PLATE_M
    )


def tree(poses: Mapping[str, Pose]) -> Iterator[tuple[str, str, Pose]]:
    """Yield parent, child and pose of each frame of a scene, from the root on, whose z points up."""
    yield ROOT, INERTIAL, UPSIDE_DOWN
    yield from ((INERTIAL, name, pose) for name, pose in poses.items() if name != INERTIAL)


def quaternion(R: Array) -> Array:
    """Return the quaternion (w, x, y, z) of a rotation matrix, (4,)."""
    return np.asarray(np.roll(Rotation.from_matrix(R).as_quat(), 1))


def _segments(path: Array) -> Array:
    """Return the segments of a path, (k, 2, 3), from its points, (k + 1, 3)."""
    return np.stack([path[:-1], path[1:]], axis=1)


def _lines(
    name: str, frame: str, layer: str, width: float, coloured: Iterable[tuple[Colour, Array]]
) -> Lines:
    """Return segments, (k, 2, 3) each, in their colours."""
    parts = list(coloured)
    segments = np.concatenate([np.zeros((0, 2, 3)), *(piece for _, piece in parts)])
    colours = np.concatenate(
        [np.zeros((0, 3)), *(np.tile(colour, (len(piece), 1)) for colour, piece in parts)]
    )
    return Lines(name, frame, layer, width, segments, colours)


def _solid(
    name: str, frame: str, points: Array, colour: Colour, *, layer: str = "", opacity: float = 1.0
) -> Mesh:
    """Return the convex hull of points, (V, 3), with triangles that face outwards."""
    hull = ConvexHull(points)
    a, b, c = points[hull.simplices].transpose(1, 0, 2)
    inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    faces = np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices)
    return Mesh(name, frame, layer, points, faces, colour, opacity)


def _prism(flat: Array, *heights: float) -> Array:
    """Return points, (k, 2), at each of some heights, (heights k, 3)."""
    return np.vstack([np.column_stack([flat, np.full(len(flat), z)]) for z in heights])


def _ball(radius: float) -> Array:
    """Return points of a sphere, (18, 3)."""
    grid = np.array(
        [
            (x, y, z)
            for x in (-1, 0, 1)
            for y in (-1, 0, 1)
            for z in (-1, 0, 1)
            if abs(x) + abs(y) + abs(z)
        ]
    )
    points: Array = radius * grid / np.linalg.norm(grid, axis=1, keepdims=True)
    return points


def _disc(radius: float, *heights: float) -> Array:
    """Return points of a flat cylinder about the z axis between heights, (16 heights, 3)."""
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    return _prism(radius * np.column_stack([np.cos(angles), np.sin(angles)]), *heights)
