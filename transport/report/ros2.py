"""Messages of ROS 2 about a run.

Poses, twists, plans, transforms and markers, as CDR; and a bag of a recorded run.

Poses are in the frame "inertial", z down, whose parent "map" has z up. Plans are the predicted
paths of the scene, and markers are its drawing, as in the viewer.
"""

from collections.abc import Iterator, Mapping
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.model.rotations import rotation
from transport.model.state import StateView
from transport.report.mcap_copy import (
    Fields,
    Schema,
    colour_fields,
    mcap_copy,
    point_fields,
    pose_fields,
)
from transport.scene.bodies import INERTIAL
from transport.scene.drawing import PAYLOAD, ROOT, UPSIDE_DOWN, Drawing, tree
from transport.scene.parts import Label, Lines, Mesh, Part
from transport.scene.scene import SceneBuilder

_GEOMETRY = "geometry_msgs/msg"
# Topic and type of targets.
TARGET = "/target", f"{_GEOMETRY}/PoseStamped"
_LINE_LIST, _TEXT, _TRIANGLES, _DELETE = 5, 9, 11, 2  # visualization_msgs/msg/Marker
# Width of a drawn line per pixel of the viewer, and height of names, m.
_LINE_M, _TEXT_M = 0.004, 0.12
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
    fields = types().fielddefs[kind][1]
    return types().types[kind](
        **{name: _field(node, about, given.get(name)) for name, (node, about) in fields}
    )


def _field(node: Any, about: Any, value: Any) -> Any:
    match node.name:
        case "NAME":
            return _message(about, value or {})
        case "BASE":
            return _EMPTY.get(about[0], 0) if value is None else value
    (of, inner), _ = about
    return (
        np.zeros(0, dtype=inner[0])
        if of.name == "BASE"
        else [_message(inner, each) for each in value or ()]
    )


class GoalError(ValueError):
    """A pose that is no target; the text says what was expected and what came."""


def goal_in(data: bytes) -> Array:
    """Return the position of a geometry_msgs/PoseStamped in CDR in the inertial frame, (3,), m.

    Raises: GoalError: it is none, in another frame than "inertial", none, or "map", or not finite.
    """
    try:
        goal: Any = types().deserialize_cdr(data, TARGET[1])
    except SerdeError as error:
        raise GoalError(f"expected a PoseStamped ({error})") from error
    place, frame = (
        np.array([getattr(goal.pose.position, axis) for axis in "xyz"]),
        goal.header.frame_id,
    )
    if not np.isfinite(place).all():
        raise GoalError("expected a finite position, got nan or infinity")
    if frame not in ("", INERTIAL, ROOT):
        raise GoalError(f"expected the frame {INERTIAL} or {ROOT}, got {frame[:40]!r}")
    turned: Array = UPSIDE_DOWN[1] @ place
    return turned if frame == ROOT else place


class Ros2Messages:
    """Messages about the ticks of one run, whose history may grow.

    `topics` has the type of each topic.
    """

    def __init__(self, builder: SceneBuilder) -> None:
        self._builder, self._drawing = builder, Drawing(builder)
        self.period_ns, self.speed = builder.setup.period_ns, builder.setup.scenario.clock.speed
        uavs = self._uavs = [f"uav{i + 1}" for i in range(builder.setup.system.N)]
        self.topics = {
            "/tf": "tf2_msgs/msg/TFMessage",
            "/markers": "visualization_msgs/msg/MarkerArray",
        }
        self.topics |= {
            f"/{body}/pose": f"{_GEOMETRY}/PoseStamped" for body in [PAYLOAD, *uavs, "reference"]
        }
        self.topics |= {f"/{body}/twist": f"{_GEOMETRY}/TwistStamped" for body in [PAYLOAD, *uavs]}
        plans = [*uavs, *(f"agent{agent}/{PAYLOAD}" for agent in builder.setup.agents)]
        self.topics |= {f"/{name}/plan": "nav_msgs/msg/Path" for name in plans}

    def states(self, tick: int, at_ns: int) -> Iterator[tuple[str, bytes]]:
        """Yield topic and bytes of poses and twists at a tick, stamped with a time, ns."""
        setup, x = self._builder.setup, self._builder.history.plant_states[tick].x
        view, uavs_I = StateView(x), setup.model.outputs(x)[: 3 * setup.system.N].reshape(-1, 3)
        places, turns = [view.r0_I, *uavs_I], map(rotation, [view.Theta0, *view.Theta])
        speeds, spins = setup.model.velocities(x).reshape(-1, 3), [view.omega0_P, *view.omega_B]
        names = [PAYLOAD, *self._uavs]
        for name, place, R, velocity, rates in zip(
            names, places, turns, speeds, spins, strict=True
        ):
            yield self._told(f"/{name}/pose", _stamped(at_ns) | {"pose": pose_fields(place, R)})
            twist = {"linear": point_fields(velocity), "angular": point_fields(R @ rates)}
            yield self._told(f"/{name}/twist", _stamped(at_ns) | {"twist": twist})
        goal_I = setup.maneuver.path(np.array([tick * setup.settings.sampling_period_s]))[0][0]
        yield self._told("/reference/pose", _stamped(at_ns) | {"pose": pose_fields(goal_I)})

    def scenes(self, tick: int, at_ns: int, *, fixed: bool) -> Iterator[tuple[str, bytes]]:
        """Yield topic and bytes of plans, transforms and markers, with `fixed` those of the bodies too."""
        scene = self._builder.at(tick)
        for found in scene.predictions:
            for k, uav in enumerate(self._builder.setup.owned[found.agent - 1]):
                yield self._told(f"/uav{uav + 1}/plan", self._path(found.uavs_I[:, k], at_ns))
            yield self._told(
                f"/agent{found.agent}/{PAYLOAD}/plan", self._path(found.payload_I, at_ns)
            )
        poses, transforms = self._drawing.poses(scene), []
        for parent, child, pose in tree(poses):
            place = pose_fields(*pose)
            transform = {"translation": place["position"], "rotation": place["orientation"]}
            transforms.append(
                _stamped(at_ns, parent) | {"child_frame_id": child, "transform": transform}
            )
        yield self._told("/tf", {"transforms": transforms})
        parts: list[Part] = [lines for lines in self._drawing.moving(scene) if len(lines.segments)]
        markers = [
            _marker(part, at_ns, poses)
            for part in [*parts, *(self._drawing.fixed if fixed else ())]
        ]
        yield self._told("/markers", {"markers": markers})

    def _told(self, topic: str, given: Fields) -> tuple[str, bytes]:
        return topic, cdr(self.topics[topic], given)

    def _path(self, positions: Array, at_ns: int) -> Fields:
        times_ns = [at_ns + k * self.period_ns for k in range(len(positions))]
        poses = [
            _stamped(t) | {"pose": pose_fields(place)}
            for t, place in zip(times_ns, positions, strict=True)
        ]
        return _stamped(at_ns) | {"poses": poses}


def _stamped(at_ns: int, frame: str = INERTIAL) -> Fields:
    return {
        "header": {"stamp": {"sec": at_ns // 10**9, "nanosec": at_ns % 10**9}, "frame_id": frame}
    }


def _marker(part: Part, at_ns: int, frames: Mapping[str, Any]) -> Fields:
    """Return a part as a marker, which moves with its frame.

    One without a frame, as of a UAV that left, is deleted.
    """
    marker = _stamped(at_ns, part.frame) | {"ns": f"{part.frame}/{part.name}", "frame_locked": True}
    match part:
        case _ if part.frame not in frames:
            return marker | {"action": _DELETE}
        case Lines():
            points = [point_fields(point) for point in part.segments.reshape(-1, 3)]
            colours = [colour_fields(colour) for colour in np.repeat(part.colours, 2, axis=0)]
            scale = point_fields(np.full(3, part.width * _LINE_M))
            shape = {
                "type": _LINE_LIST,
                "points": points,
                "colors": colours,
                "scale": scale,
                "pose": pose_fields(),
            }
            return marker | shape | {"color": colour_fields((0, 0, 0))}
        case Label():
            shape = {"type": _TEXT, "text": part.text, "scale": point_fields(np.full(3, _TEXT_M))}
            return (
                marker
                | shape
                | {"pose": pose_fields(part.position), "color": colour_fields(part.colour)}
            )
        case Mesh():
            points = [point_fields(point) for point in part.vertices[part.faces.reshape(-1)]]
            shape = {
                "type": _TRIANGLES,
                "points": points,
                "scale": point_fields(np.ones(3)),
                "pose": pose_fields(),
            }
            return marker | shape | {"color": colour_fields(part.colour, part.opacity)}


def write_bag(builder: SceneBuilder, log: RunLog, out: Path) -> int:
    """Write a recorded run as an MCAP file for ROS 2, stamped with scenario time.

    Return the number of ticks.
    """
    messages, ticks, schemas = Ros2Messages(builder), sorted(builder.history.plant_states), {}
    for topic, kind in messages.topics.items():
        definition = types().generate_msgdef(kind, ros_version=2)[0].encode()
        schemas[topic] = Schema(kind, "ros2msg", definition, "cdr")
    with mcap_copy(out, log.header, profile="ros2") as put:
        for tick in ticks:
            at_ns = tick * builder.setup.period_ns
            scenes = messages.scenes(tick, at_ns, fixed=tick == ticks[0])
            for topic, data in chain(messages.states(tick, at_ns), scenes):
                put(topic, schemas[topic], data, at_ns)
    return len(ticks)
