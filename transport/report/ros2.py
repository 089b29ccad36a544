"""Messages of ROS 2 about a run: poses, twists, plans, transforms and markers, as CDR; and a bag of a recorded run.

Poses are in the frame "inertial", z down, whose parent "map" has z up. Plans are the predicted paths of the scene, and
markers are its drawing, as in the viewer.
"""

from collections.abc import Iterator, Sequence
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from model.arrays import Array
from model.rotations import rotation
from model.state import StateView
from transport.log.run_log import RunLog
from transport.report.mcap_copy import Schema, mcap_copy
from transport.scene.drawing import INERTIAL, PAYLOAD, ROOT, UPSIDE_DOWN, Drawing, Label, Lines, Part, quaternion, tree
from transport.scene.drawing import Pose as FramePose
from transport.scene.scene import SceneBuilder

# Topic and type of targets.
TARGET = "/target", "geometry_msgs/msg/PoseStamped"
_LINE_LIST, _TEXT, _TRIANGLES, _DELETE = 5, 9, 11, 2  # visualization_msgs/msg/Marker
# Width of a drawn line per pixel of the viewer, and height of names, m.
_LINE_M, _TEXT_M = 0.004, 0.12
_LEVEL = np.eye(3)

# A topic, and a message for it.
Told = tuple[str, Any]


@cache
def types() -> Any:
    """Return the message types of ROS 2."""
    return get_typestore(Stores.ROS2_JAZZY)


def cdr(message: Any) -> bytes:
    """Return a message as bytes."""
    return bytes(types().serialize_cdr(message, message.__msgtype__, little_endian=True))


def _new(kind: str, **fields: Any) -> Any:
    package, name = kind.split("/")
    return types().types[f"{package}/msg/{name}"](**fields)


def _header(at_ns: int, frame: str = INERTIAL) -> Any:
    stamp = _new("builtin_interfaces/Time", sec=at_ns // 10**9, nanosec=at_ns % 10**9)
    return _new("std_msgs/Header", stamp=stamp, frame_id=frame)


def _vector(kind: str, values: Array) -> Any:
    return _new(f"geometry_msgs/{kind}", **dict(zip("xyz", map(float, values), strict=True)))


def _rotation(R: Array) -> Any:
    return _new("geometry_msgs/Quaternion", **dict(zip("wxyz", quaternion(R).tolist(), strict=True)))


def _pose(position: Array, R: Array = _LEVEL) -> Any:
    return _new("geometry_msgs/Pose", position=_vector("Point", position), orientation=_rotation(R))


def _pose_stamped(at_ns: int, position: Array, R: Array = _LEVEL) -> Any:
    return _new("geometry_msgs/PoseStamped", header=_header(at_ns), pose=_pose(position, R))


class GoalError(ValueError):
    """A pose that is no target; the text says what was expected and what came."""


def goal_in(data: bytes) -> Array:
    """Return the position of a geometry_msgs/PoseStamped in CDR in the inertial frame, (3,), m.

    Raises: GoalError: it is none, is in another frame than "inertial", none, or "map", or is not finite.
    """
    try:
        goal: Any = types().deserialize_cdr(data, TARGET[1])
    except SerdeError as error:
        raise GoalError(f"expected a PoseStamped ({error})") from error
    place, frame = np.array([getattr(goal.pose.position, axis) for axis in "xyz"]), goal.header.frame_id
    if not np.isfinite(place).all():
        raise GoalError("expected a finite position, got nan or infinity")
    if frame not in ("", INERTIAL, ROOT):
        raise GoalError(f"expected the frame {INERTIAL} or {ROOT}, got {frame[:40]!r}")
    turned: Array = UPSIDE_DOWN[1] @ place
    return turned if frame == ROOT else place


class Ros2Messages:
    """Messages about the ticks of one run, whose history may grow."""

    def __init__(self, builder: SceneBuilder) -> None:
        self._builder, self._drawing = builder, Drawing(builder)
        self.period_ns, self.speed = builder.setup.period_ns, builder.setup.scenario.clock.speed

    def topics(self) -> dict[str, str]:
        """Return the type of each topic."""
        setup, geometry = self._builder.setup, "geometry_msgs/msg"
        bodies = [PAYLOAD, *(f"uav{i + 1}" for i in range(setup.system.N))]
        found = {"/tf": "tf2_msgs/msg/TFMessage", "/markers": "visualization_msgs/msg/MarkerArray"}
        found |= {f"/{body}/pose": f"{geometry}/PoseStamped" for body in [*bodies, "reference"]}
        found |= {f"/{body}/twist": f"{geometry}/TwistStamped" for body in bodies}
        plans = [*bodies[1:], *(f"agent{agent}/{PAYLOAD}" for agent in setup.agents)]
        return found | {f"/{name}/plan": "nav_msgs/msg/Path" for name in plans}

    def states(self, tick: int, at_ns: int) -> Iterator[Told]:
        """Yield poses and twists at a tick, stamped with a time, ns."""
        setup, x = self._builder.setup, self._builder.history.plant_states[tick].x
        view, places = StateView(x), setup.model.outputs(x)[: 3 * setup.system.N].reshape(-1, 3)
        bodies = zip(
            [PAYLOAD, *(f"uav{i + 1}" for i in range(setup.system.N))],
            [view.r0_I, *places],
            map(rotation, [view.Theta0, *view.Theta]),
            setup.model.velocities(x).reshape(-1, 3),
            [view.omega0_P, *view.omega_B],
            strict=True,
        )
        for name, place, R, velocity, rates in bodies:
            yield f"/{name}/pose", _pose_stamped(at_ns, place, R)
            linear, angular = _vector("Vector3", velocity), _vector("Vector3", R @ rates)
            twist = _new("geometry_msgs/Twist", linear=linear, angular=angular)
            yield f"/{name}/twist", _new("geometry_msgs/TwistStamped", header=_header(at_ns), twist=twist)
        goal_I = setup.maneuver.path(np.array([tick * setup.settings.sampling_period_s]))[0][0]
        yield "/reference/pose", _pose_stamped(at_ns, goal_I)

    def scenes(self, tick: int, at_ns: int, *, fixed: bool) -> Iterator[Told]:
        """Yield plans, transforms and markers at a tick, stamped with a time, ns; with `fixed` also the bodies'."""
        scene = self._builder.at(tick)
        for found in scene.predictions:
            for k, uav in enumerate(self._builder.setup.owned[found.agent - 1]):
                yield f"/uav{uav + 1}/plan", self._path(found.uavs_I[:, k], at_ns)
            yield f"/agent{found.agent}/{PAYLOAD}/plan", self._path(found.payload_I, at_ns)
        poses = self._drawing.poses(scene)
        transforms = [_transform(*link, at_ns) for link in tree(poses)]
        yield "/tf", _new("tf2_msgs/TFMessage", transforms=transforms)
        parts: list[Part] = [lines for lines in self._drawing.moving(scene, flown=False) if len(lines.segments)]
        markers = [_marker(part, at_ns) for part in [*parts, *(self._drawing.fixed if fixed else ())]]
        for marker in markers:
            if marker.header.frame_id not in poses:  # a UAV that has left
                marker.action = _DELETE
        yield "/markers", _new("visualization_msgs/MarkerArray", markers=markers)

    def _path(self, positions: Array, at_ns: int) -> Any:
        poses = [_pose_stamped(at_ns + k * self.period_ns, position) for k, position in enumerate(positions)]
        return _new("nav_msgs/Path", header=_header(at_ns), poses=poses)


def _transform(parent: str, child: str, pose: FramePose, at_ns: int) -> Any:
    transform = _new("geometry_msgs/Transform", translation=_vector("Vector3", pose[0]), rotation=_rotation(pose[1]))
    header = _header(at_ns, parent)
    return _new("geometry_msgs/TransformStamped", header=header, child_frame_id=child, transform=transform)


def _marker(part: Part, at_ns: int) -> Any:
    """Return a part of the drawing as a marker, which moves with its frame and replaces the last of its name."""
    kind, points, colours, text, scale = _TRIANGLES, np.zeros((0, 3)), np.zeros((0, 3)), "", np.ones(3)
    place, colour, opacity = np.zeros(3), (0.0, 0.0, 0.0), 1.0
    match part:
        case Lines():
            kind, points, colours = _LINE_LIST, part.segments.reshape(-1, 3), np.repeat(part.colours, 2, axis=0)
            scale = np.full(3, part.width * _LINE_M)
        case Label():
            kind, place, colour, text, scale = _TEXT, part.position, part.colour, part.text, np.full(3, _TEXT_M)
        case _:
            points, colour, opacity = part.vertices[part.faces.reshape(-1)], part.colour, part.opacity
    return _new(
        "visualization_msgs/Marker",
        header=_header(at_ns, part.frame),
        ns=f"{part.frame}/{part.name}",
        id=0,
        type=kind,
        action=0,
        pose=_pose(place),
        scale=_vector("Vector3", scale),
        color=_colour(colour, opacity),
        lifetime=_new("builtin_interfaces/Duration", sec=0, nanosec=0),
        frame_locked=True,
        points=[_vector("Point", point) for point in points],
        colors=[_colour(given) for given in colours],
        texture_resource="",
        texture=_new("sensor_msgs/CompressedImage", header=_header(0, ""), format="", data=np.zeros(0, dtype=np.uint8)),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=_new("visualization_msgs/MeshFile", filename="", data=np.zeros(0, dtype=np.uint8)),
        mesh_use_embedded_materials=False,
    )


def _colour(colour: Sequence[float] | Array, opacity: float = 1.0) -> Any:
    r, g, b = (float(channel) / 255.0 for channel in colour)
    return _new("std_msgs/ColorRGBA", r=r, g=g, b=b, a=float(opacity))


def write_bag(builder: SceneBuilder, log: RunLog, out: Path) -> int:
    """Write a recorded run as an MCAP file for ROS 2, stamped with scenario time; return the number of ticks.

    Raises: OSError: it cannot be written.
    """
    messages, ticks = Ros2Messages(builder), sorted(builder.history.plant_states)
    kinds = set(messages.topics().values())
    definitions = {kind: types().generate_msgdef(kind, ros_version=2)[0].encode() for kind in kinds}
    with mcap_copy(out, log.header, profile="ros2") as copy:
        for tick in ticks:
            at_ns = tick * builder.setup.period_ns
            scenes = messages.scenes(tick, at_ns, fixed=tick == ticks[0])
            for topic, message in chain(messages.states(tick, at_ns), scenes):
                kind = message.__msgtype__
                copy.put(topic, Schema(kind, "ros2msg", definitions[kind], "cdr"), cdr(message), at_ns)
    return len(ticks)
