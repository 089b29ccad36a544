"""Messages of ROS 2 about a run: poses, twists, plans, transforms and markers, as CDR; and a bag of a recorded run.

Poses are in the frame "inertial", z down, whose parent "map" has z up. Plans are the predicted paths of the scene, and
markers are its drawing, as in the viewer.
"""

import struct
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from model.arrays import Array
from model.rotations import rotation
from model.state import StateView
from transport.log.run_log import RunLog
from transport.scene.drawing import INERTIAL, PAYLOAD, Drawing, Label, Lines, Part, quaternion
from transport.scene.drawing import Pose as FramePose
from transport.scene.scene import Scene, SceneBuilder

ROOT = "map"
# Topic and type of targets; first bytes of CDR, and where the name of the frame begins in a stamped message.
TARGET = "/target", "geometry_msgs/msg/PoseStamped"
_LITTLE_ENDIAN, _FRAME_AT = b"\x00\x01", 16
_UPSIDE_DOWN: FramePose = (np.zeros(3), np.diag([1.0, -1.0, -1.0]))
_LINE_LIST, _TEXT, _TRIANGLES, _DELETE = 5, 9, 11, 2  # visualization_msgs/msg/Marker
# Width of a drawn line per pixel of the viewer, and height of names, m.
_LINE_M, _TEXT_M = 0.004, 0.12

# A message: topic, type, and content.
Told = tuple[str, str, Any]


@cache
def types() -> Any:
    """Return the message types of ROS 2."""
    return get_typestore(Stores.ROS2_JAZZY)


def cdr(kind: str, message: Any) -> bytes:
    """Return a message of a type such as "geometry_msgs/msg/PoseStamped" as bytes."""
    return bytes(types().serialize_cdr(message, kind, little_endian=True))


def _new(kind: str, **fields: Any) -> Any:
    package, name = kind.split("/")
    return types().types[f"{package}/msg/{name}"](**fields)


def _time(at_ns: int) -> Any:
    return _new("builtin_interfaces/Time", sec=at_ns // 10**9, nanosec=at_ns % 10**9)


def _header(at_ns: int, frame: str = INERTIAL) -> Any:
    return _new("std_msgs/Header", stamp=_time(at_ns), frame_id=frame)


def _vector(kind: str, values: Array) -> Any:
    return _new(f"geometry_msgs/{kind}", **dict(zip("xyz", map(float, values), strict=True)))


def _rotation(R: Array) -> Any:
    return _new("geometry_msgs/Quaternion", **dict(zip("wxyz", quaternion(R).tolist(), strict=True)))


def _pose(position: Array, R: Array | None = None) -> Any:
    turned = _rotation(np.eye(3) if R is None else R)
    return _new("geometry_msgs/Pose", position=_vector("Point", position), orientation=turned)


class GoalError(ValueError):
    """A pose that is no target; the text says what was expected and what came."""


def goal_in(data: bytes) -> Array:
    """Return the position of a geometry_msgs/PoseStamped in CDR in the inertial frame, (3,), m.

    Raises: GoalError: it has another size, or another frame than "inertial", none, or "map", or is not finite.
    """
    if len(data) < _FRAME_AT or data[:2] != _LITTLE_ENDIAN:
        raise GoalError("expected little-endian CDR")
    (length,) = struct.unpack_from("<I", data, _FRAME_AT - 4)
    begin = _FRAME_AT + length + (4 - _FRAME_AT - length) % 8  # aligned after the four bytes of CDR's own header
    if len(data) != begin + 7 * 8:
        raise GoalError(f"expected a PoseStamped of {begin + 56} bytes, got {len(data)}")
    frame, place = data[_FRAME_AT : _FRAME_AT + length].rstrip(b"\0").decode(errors="replace"), np.zeros(3)
    place[:] = struct.unpack_from("<3d", data, begin)
    if not np.isfinite(place).all():
        raise GoalError("expected a finite position, got nan or infinity")
    if frame not in ("", INERTIAL, ROOT):
        raise GoalError(f"expected the frame {INERTIAL} or {ROOT}, got {frame[:40]!r}")
    turned: Array = _UPSIDE_DOWN[1] @ place
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
        setup, history = self._builder.setup, self._builder.history
        x, header = history.plant_states[tick].x, _header(at_ns)
        view, bodies, geometry = StateView(x), 1 + setup.system.N, "geometry_msgs/msg"
        places = [view.r0_I, *setup.model.outputs(x)[: 3 * setup.system.N].reshape(-1, 3)]
        angles, rates = [view.Theta0, *view.Theta], [view.omega0_P, *view.omega_B]
        velocities = setup.model.velocities(x).reshape(-1, 3)
        for i, name in enumerate([PAYLOAD, *(f"uav{i}" for i in range(1, bodies))]):
            R = rotation(angles[i])
            linear, angular = _vector("Vector3", velocities[i]), _vector("Vector3", R @ rates[i])
            twist = _new("geometry_msgs/Twist", linear=linear, angular=angular)
            pose = _new("geometry_msgs/PoseStamped", header=header, pose=_pose(places[i], R))
            yield f"/{name}/pose", f"{geometry}/PoseStamped", pose
            stamped = _new("geometry_msgs/TwistStamped", header=header, twist=twist)
            yield f"/{name}/twist", f"{geometry}/TwistStamped", stamped
        goal = _pose(setup.maneuver.path(np.array([tick * setup.settings.sampling_period_s]))[0][0])
        yield "/reference/pose", f"{geometry}/PoseStamped", _new("geometry_msgs/PoseStamped", header=header, pose=goal)

    def scenes(self, tick: int, at_ns: int, *, fixed: bool) -> Iterator[Told]:
        """Yield plans, transforms and markers at a tick, stamped with a time, ns; with `fixed` also the bodies'."""
        kinds, scene = self.topics(), self._builder.at(tick)
        for topic, path in self._plans(scene, at_ns):
            yield topic, kinds[topic], path
        poses = self._drawing.poses(scene)
        transforms = [_transform(ROOT, INERTIAL, _UPSIDE_DOWN, at_ns)]
        transforms += [_transform(INERTIAL, name, pose, at_ns) for name, pose in poses.items() if name != INERTIAL]
        yield "/tf", kinds["/tf"], _new("tf2_msgs/TFMessage", transforms=transforms)
        parts: list[Part] = list(self._drawing.moving(scene, flown=False))
        markers = [_marker(part, at_ns) for part in [*parts, *(self._drawing.fixed if fixed else ())] if _shown(part)]
        for marker in markers:
            if marker.header.frame_id not in poses:  # a UAV that has left
                marker.action = _DELETE
        yield "/markers", kinds["/markers"], _new("visualization_msgs/MarkerArray", markers=markers)

    def _plans(self, scene: Scene, at_ns: int) -> Iterator[tuple[str, Any]]:
        def path(positions: Array) -> Any:
            poses = [
                _new("geometry_msgs/PoseStamped", header=_header(at_ns + k * self.period_ns), pose=_pose(position))
                for k, position in enumerate(positions)
            ]
            return _new("nav_msgs/Path", header=_header(at_ns), poses=poses)

        for found in scene.predictions:
            for k, uav in enumerate(self._builder.setup.owned[found.agent - 1]):
                yield f"/uav{uav + 1}/plan", path(found.uavs_I[:, k])
            yield f"/agent{found.agent}/{PAYLOAD}/plan", path(found.payload_I)


def _transform(parent: str, child: str, pose: FramePose, at_ns: int) -> Any:
    transform = _new("geometry_msgs/Transform", translation=_vector("Vector3", pose[0]), rotation=_rotation(pose[1]))
    header = _header(at_ns, parent)
    return _new("geometry_msgs/TransformStamped", header=header, child_frame_id=child, transform=transform)


def _shown(part: Part) -> bool:
    """Return whether a part has anything to draw."""
    return not isinstance(part, Lines) or len(part.segments) > 0


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
    partial = out.with_name(out.name + ".partial")
    with partial.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="payload-transport")
        writer.add_metadata("exported run", dict(log.header))
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for topic, kind in messages.topics().items():
            if kind not in schemas:
                definition = types().generate_msgdef(kind, ros_version=2)[0].encode()
                schemas[kind] = writer.register_schema(kind, "ros2msg", definition)
            channels[topic] = writer.register_channel(topic, "cdr", schemas[kind])
        for tick in ticks:
            at_ns = tick * builder.setup.period_ns
            for topic, kind, message in chain(
                messages.states(tick, at_ns), messages.scenes(tick, at_ns, fixed=tick == ticks[0])
            ):
                writer.add_message(channels[topic], at_ns, cdr(kind, message), publish_time=at_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    partial.replace(out)
    return len(ticks)
