"""Messages of ROS 2 about a run: poses, twists, plans, transforms and markers; and a bag of a run.

Messages are in CDR. Poses are in the frame "inertial", z down, whose parent "map" has z up. Plans
are the predicted paths of the scene, and markers are its drawing, as in the viewer.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.model.physics.rotations import rotation
from transport.model.state import StateView
from transport.protocol.scenario.files.atomic_writing import atomic_file
from transport.report.ros2_markers import Fields, marker_fields, point_fields, pose_fields, stamped
from transport.scene.drawn_paths_links_and_thrust import Drawing
from transport.scene.frames_and_poses import (
    INERTIAL,
    PAYLOAD,
    ROOT,
    UPSIDE_DOWN,
    poses_in_scene,
    tree,
)
from transport.scene.lines_meshes_and_labels import Part, Pose
from transport.scene.scene_at_tick import SceneBuilder

_GEOMETRY = "geometry_msgs/msg"
# Metadata record with the header of the log; another name than in a log, which a bag is not.
_HEADER = "exported run"
TARGET_TYPE = f"{_GEOMETRY}/PoseStamped"
# Values of fields that are not given; of other types 0.
_EMPTY = {"string": "", "bool": False}


@cache
def types() -> Any:
    """Return the message types of ROS 2."""
    return get_typestore(Stores.ROS2_JAZZY)


def cdr(kind: str, given: Fields) -> bytes:
    """Return a message of a type such as "geometry_msgs/msg/PoseStamped" as bytes.

    All fields not given are empty.
    """
    return bytes(types().serialize_cdr(_message(kind, given), kind, little_endian=True))


def _message(kind: str, given: Fields) -> Any:
    """Return a message of a type, whose fields that are not given are empty."""
    _, fields = types().fielddefs[kind]
    values = {name: _field(node, about, given.get(name)) for name, (node, about) in fields}
    return types().types[kind](**values)


def _field(node: Any, about: Any, value: Any) -> Any:
    """Return the value of a field: a message, a plain value, or a list of messages."""
    match node.name:
        case "NAME":
            return _message(about, value or {})
        case "BASE":
            return _EMPTY.get(about[0], 0) if value is None else value

    (entry, inner), _ = about
    if entry.name == "BASE":  # numbers, as in the fields of a marker that its kind does not use
        return np.zeros(0, dtype=inner[0]) if value is None else np.asarray(value, dtype=inner[0])
    return [_message(inner, each) for each in value or ()]


class GoalError(ValueError):
    """A pose that is no target; the text says what was expected and what came."""


def goal_in(data: bytes) -> Array:
    """Return the position of a geometry_msgs/PoseStamped in CDR in the inertial frame, (3,), m.

    Raises: GoalError: it is no such message, not finite, or in another frame than "inertial", the
        empty one, or "map".
    """
    try:
        goal: Any = types().deserialize_cdr(data, TARGET_TYPE)
    except SerdeError as error:
        raise GoalError(f"expected a PoseStamped ({error})") from error

    place = np.array([getattr(goal.pose.position, axis) for axis in "xyz"])
    frame = goal.header.frame_id
    if not np.isfinite(place).all():
        raise GoalError("expected a finite position, got nan or infinity")
    if frame not in ("", INERTIAL, ROOT):
        raise GoalError(f"expected the frame {INERTIAL} or {ROOT}, got {frame[:40]!r}")

    turned: Array = UPSIDE_DOWN[1] @ place
    return turned if frame == ROOT else place


class Ros2Messages:
    """Messages about the ticks of one run, whose history may grow.

    Args:
        stamps_apart_ns: Time between the stamps of two ticks, ns, and so of the points of a plan.

    Attributes:
        topics: Type of each topic.
    """

    def __init__(self, builder: SceneBuilder, stamps_apart_ns: int) -> None:
        setup = builder.setup
        self._stamps_apart_ns = stamps_apart_ns
        self._builder = builder
        self._drawing = Drawing(builder)
        self._uavs = [f"uav{i + 1}" for i in range(setup.system.N)]
        self.topics = _topics(self._uavs, setup.agents)

    def states(self, tick: int, at_ns: int) -> Iterator[tuple[str, bytes]]:
        """Yield topic and bytes of poses and twists at a tick, stamped with a time, ns."""
        setup = self._builder.setup
        for body in self._bodies(tick):
            pose = {"pose": pose_fields(body.position_I, body.R)}
            yield self._told(f"/{body.name}/pose", stamped(at_ns) | pose)
            omega_I = body.R @ body.omega  # ROS states twists in the frame of the header
            twist = {
                "linear": point_fields(body.velocity_I),
                "angular": point_fields(omega_I),
            }
            yield self._told(f"/{body.name}/twist", stamped(at_ns) | {"twist": twist})

        time_s = tick * setup.settings.sampling_period_s
        goal_I = setup.maneuver.path(np.array([time_s]))[0][0]
        yield self._told("/reference/pose", stamped(at_ns) | {"pose": pose_fields(goal_I)})

    def _bodies(self, tick: int) -> list["_Body"]:
        """Return the motion of payload and UAVs at a tick."""
        setup = self._builder.setup
        x = self._builder.history.plant_states[tick].x
        view = StateView(x)
        uavs_I = setup.model.outputs(x)[: 3 * setup.system.N].reshape(-1, 3)
        velocities_I = setup.model.velocities(x).reshape(-1, 3)
        payload = _Body(
            name=PAYLOAD,
            position_I=view.r0_I,
            R=rotation(view.Theta0),
            velocity_I=velocities_I[0],
            omega=view.omega0_P,
        )
        uavs = [
            _Body(
                name=name,
                position_I=uavs_I[i],
                R=rotation(view.Theta[i]),
                velocity_I=velocities_I[i + 1],
                omega=view.omega_B[i],
            )
            for i, name in enumerate(self._uavs)
        ]
        return [payload, *uavs]

    def scenes(self, tick: int, at_ns: int, *, fixed: bool) -> Iterator[tuple[str, bytes]]:
        """Yield topic and bytes of plans, transforms and markers at a tick.

        With `fixed` the markers of the bodies are among them.
        """
        scene = self._builder.at(tick)
        for prediction in scene.predictions:
            for k, uav in enumerate(self._builder.setup.owned[prediction.agent - 1]):
                path = self._path(prediction.uavs_I[:, k], at_ns)
                yield self._told(f"/uav{uav + 1}/plan", path)
            payload_path = self._path(prediction.payload_I, at_ns)
            yield self._told(f"/agent{prediction.agent}/{PAYLOAD}/plan", payload_path)

        poses = poses_in_scene(scene)
        transforms = [_transform(*link, at_ns) for link in tree(poses)]
        yield self._told("/tf", {"transforms": transforms})

        parts: list[Part] = [lines for lines in self._drawing.moving(scene) if len(lines.segments)]
        if fixed:
            parts += self._drawing.fixed
        markers = [marker_fields(part, at_ns, poses) for part in parts]
        yield self._told("/markers", {"markers": markers})

    def _told(self, topic: str, given: Fields) -> tuple[str, bytes]:
        """Return a topic and a message of its type."""
        return topic, cdr(self.topics[topic], given)

    def _path(self, positions_I: Array, at_ns: int) -> Fields:
        """Return a predicted path, (k, 3), one sampling period from point to point."""
        poses = [
            stamped(at_ns + k * self._stamps_apart_ns) | {"pose": pose_fields(position_I)}
            for k, position_I in enumerate(positions_I)
        ]
        return stamped(at_ns) | {"poses": poses}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Body:
    """Motion of the payload or a UAV, SI."""

    name: str
    position_I: Array  # (3,)
    R: Array  # from the body's frame to the inertial one, (3, 3)
    velocity_I: Array  # (3,)
    omega: Array  # angular velocity in the body's frame, (3,)


def _topics(uavs: Sequence[str], agents: Iterable[int]) -> dict[str, str]:
    """Return the type of each topic."""
    bodies = [PAYLOAD, *uavs]
    plans = [*uavs, *(f"agent{agent}/{PAYLOAD}" for agent in agents)]
    return {
        "/tf": "tf2_msgs/msg/TFMessage",
        "/markers": "visualization_msgs/msg/MarkerArray",
        **{f"/{body}/pose": f"{_GEOMETRY}/PoseStamped" for body in [*bodies, "reference"]},
        **{f"/{body}/twist": f"{_GEOMETRY}/TwistStamped" for body in bodies},
        **{f"/{name}/plan": "nav_msgs/msg/Path" for name in plans},
    }


def _transform(parent: str, child: str, pose: Pose, at_ns: int) -> Fields:
    """Return the pose of a frame in its parent."""
    place = pose_fields(*pose)
    transform = {"translation": place["position"], "rotation": place["orientation"]}
    return stamped(at_ns, parent) | {"child_frame_id": child, "transform": transform}


def write_bag(builder: SceneBuilder, log: RunLog, out: Path) -> int:
    """Write a recorded run as an MCAP file for ROS 2, stamped with scenario time, whole or not at all.

    Return the number of ticks.
    """
    period_ns = builder.setup.period_ns
    messages = Ros2Messages(builder, stamps_apart_ns=period_ns)
    ticks = sorted(builder.history.plant_states)
    with atomic_file(out) as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="payload-transport")
        writer.add_metadata(_HEADER, dict(log.header))

        channels = {}
        for topic, kind in messages.topics.items():
            definition = types().generate_msgdef(kind, ros_version=2)[0].encode()
            schema = writer.register_schema(kind, "ros2msg", definition)
            channels[topic] = writer.register_channel(topic, "cdr", schema)

        for tick in ticks:
            at_ns = tick * period_ns
            scenes = messages.scenes(tick, at_ns, fixed=tick == ticks[0])
            for topic, data in chain(messages.states(tick, at_ns), scenes):
                writer.add_message(channels[topic], at_ns, data, publish_time=at_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return len(ticks)
