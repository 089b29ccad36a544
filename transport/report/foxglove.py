"""Copy of a log for Foxglove: messages as JSON, and additional channels for transforms, 3D scene and numbers.

Transforms and scenes are Foxglove's own messages in protobuf. A matrix in JSON is written row by row with its shape in
a second field (`inputs`, `inputs_shape`): viewers plot `inputs[0]`, but few plot a list of lists. A float64 is written
with the fewest digits that read back as the same bits.
"""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import orjson
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from model.arrays import Array
from protocol.wire.messages import KINDS, Message
from transport.log.run_log import RunLog, topic_of
from transport.log.writer import LAST_TIME_NS, SEQUENCES
from transport.scene.drawing import INERTIAL, Drawing, Label, Lines, Mesh, Part, quaternion
from transport.scene.drawing import Pose as FramePose
from transport.scene.scene import Scene, SceneBuilder

# Foxglove draws z up; the inertial frame, z down, is its root turned about x.
ROOT = "map"
_UPSIDE_DOWN: FramePose = (np.zeros(3), np.diag([1.0, -1.0, -1.0]))
# Most times at which the actual paths are written, which are long.
_PATHS = 100

NUMBERS = "transport.Numbers"
# Additional channels and their schemas.
CHANNELS: Mapping[str, str] = {
    "/tf": "foxglove.FrameTransforms",
    "/scene/bodies": "foxglove.SceneUpdate",
    "/scene/paths": "foxglove.SceneUpdate",
    "/scene/now": "foxglove.SceneUpdate",
    "/numbers": NUMBERS,
}
# Metadata record with the header of the log; another name than in a log, which the copy is not.
METADATA = "exported run"

# Array fields with two axes; all others have one.
_MATRICES = ("points", "uav_states", "inputs", "corrections")
_FIELDS: dict[str, dict[str, Any]] = {
    kind: {field: get_type_hints(cls)[field] for field in cls.__struct_fields__} for kind, cls in KINDS.items()
}
_SCALARS = {str: "string", int: "integer", float: "number", bool: "boolean"}

Json = dict[str, Any]


def write_foxglove(builder: SceneBuilder, log: RunLog, out: Path) -> int:
    """Write the copy of a log, complete or cut; return the number of ticks with a scene.

    Args:
        builder: Scenes of the run, its whole log read.
        log: The run's log.
        out: File to write or replace.
    Raises: OSError: it cannot be written.
    """
    period_ns = builder.setup.period_ns
    partial_file = out.with_name(out.name + ".partial")
    with partial_file.open("wb") as file:
        copy = _Copy(Writer(file, compression=CompressionType.ZSTD))
        copy.writer.start(library="payload-transport")
        copy.writer.add_metadata(METADATA, log.header)
        for entry in log.messages:
            message = entry.message
            copy.writer.add_message(
                copy.json_channel(topic_of(message), f"transport.{type(message).__name__}", message.kind),
                min(message.tick * period_ns, LAST_TIME_NS),
                to_json(message),
                publish_time=entry.received_ns,
                sequence=message.sequence % SEQUENCES,
            )
        drawing, ticks = Drawing(builder), sorted(builder.history.plant_states)
        every, shown = max(1, len(ticks) // _PATHS), set[str]()
        for number, tick in enumerate(ticks):
            scene, at_ns = builder.at(tick), tick * period_ns
            poses = drawing.poses(scene)
            transforms = [_transform(ROOT, INERTIAL, _UPSIDE_DOWN, at_ns)]
            transforms += [_transform(INERTIAL, name, pose, at_ns) for name, pose in poses.items() if name != INERTIAL]
            copy.put("/tf", at_ns, FrameTransforms(transforms=transforms))
            if shown != poses.keys():  # at the start, and when a UAV leaves or the payload touches the ground
                shown = set(poses)
                bodies = [(_entity if part.frame in shown else _nothing)(part, at_ns) for part in drawing.fixed]
                copy.put("/scene/bodies", at_ns, SceneUpdate(entities=bodies))
            if number % every == 0 or tick == ticks[-1]:
                copy.put("/scene/paths", at_ns, SceneUpdate(entities=[_entity(drawing.flown(scene), at_ns)]))
            moving = [_entity(lines, at_ns) for lines in drawing.moving(scene, flown=False)]
            copy.put("/scene/now", at_ns, SceneUpdate(entities=moving))
            data = orjson.dumps(_numbers(scene), option=orjson.OPT_SERIALIZE_NUMPY)
            copy.writer.add_message(copy.json_channel("/numbers", NUMBERS), at_ns, data, publish_time=at_ns)
        copy.writer.finish()  # type: ignore[no-untyped-call]
    partial_file.replace(out)
    return len(ticks)


class _Copy:
    """An MCAP writer with channels and schemas, registered on first use."""

    def __init__(self, writer: Writer) -> None:
        self.writer = writer
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def json_channel(self, topic: str, name: str, kind: str = "") -> int:
        """Return the channel of a topic with messages of one kind, or of numbers, as JSON."""

        def schema() -> int:
            content = orjson.dumps(json_schema(kind) if kind else _NUMBERS)
            return int(self.writer.register_schema(name, "jsonschema", content))

        return self._channel(topic, name, "json", schema)

    def put(self, topic: str, at_ns: int, message: FrameTransforms | SceneUpdate) -> None:
        """Write one of Foxglove's messages."""
        channel = self._channel(topic, CHANNELS[topic], "protobuf", lambda: register_schema(self.writer, type(message)))
        self.writer.add_message(channel, at_ns, message.SerializeToString(), publish_time=at_ns)

    def _channel(self, topic: str, name: str, encoding: str, register: Callable[[], Any]) -> int:
        if topic not in self._channels:
            if name not in self._schemas:
                self._schemas[name] = register()
            self._channels[topic] = self.writer.register_channel(topic, encoding, self._schemas[name])
        return self._channels[topic]


def _entity(part: Part, at_ns: int) -> SceneEntity:
    """Return a part of the drawing, which moves with its frame and is replaced by the next of its name."""
    entity = _nothing(part, at_ns)
    match part:
        case Lines():
            line = LinePrimitive(
                type=LinePrimitive.LINE_LIST,
                pose=_pose(np.zeros(3)),
                thickness=part.width,
                scale_invariant=True,
                points=_points(part.segments.reshape(-1, 3)),
                colors=[_colour(colour) for colour in np.repeat(part.colours, 2, axis=0)],
            )
            entity.lines.append(line)
        case Mesh():
            mesh = TriangleListPrimitive(
                pose=_pose(np.zeros(3)),
                points=_points(part.vertices),
                color=_colour(part.colour, part.opacity),
                indices=part.faces.reshape(-1).tolist(),
            )
            entity.triangles.append(mesh)
        case Label():
            text = TextPrimitive(
                pose=_pose(part.position),
                billboard=True,
                font_size=14.0,
                scale_invariant=True,
                color=_colour(part.colour),
                text=part.text,
            )
            entity.texts.append(text)
    return entity


def _nothing(part: Part, at_ns: int) -> SceneEntity:
    """Return an entity without content in place of a part."""
    return SceneEntity(timestamp=_time(at_ns), frame_id=part.frame, id=f"{part.frame}/{part.name}", frame_locked=True)


def _transform(parent: str, child: str, pose: FramePose, at_ns: int) -> FrameTransform:
    place = _pose(*pose)
    return FrameTransform(
        timestamp=_time(at_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=place.position,
        rotation=place.orientation,
    )


def _pose(position: Array, R: Array | None = None) -> Pose:
    w, x, y, z = (1.0, 0.0, 0.0, 0.0) if R is None else quaternion(R).tolist()
    place = dict(zip("xyz", position.tolist(), strict=True))
    return Pose(position=Vector3(**place), orientation=Quaternion(x=x, y=y, z=z, w=w))


def _points(points: Array) -> list[Point3]:
    return [Point3(x=x, y=y, z=z) for x, y, z in points.tolist()]


def _colour(colour: Iterable[float], opacity: float = 1.0) -> Color:
    r, g, b = (channel / 255.0 for channel in colour)
    return Color(r=r, g=g, b=b, a=opacity)


def _time(at_ns: int) -> Timestamp:
    return Timestamp(seconds=at_ns // 10**9, nanos=at_ns % 10**9)


def _numbers(scene: Scene) -> Json:
    roll, pitch, yaw = scene.attitude_deg.tolist()
    return {
        "cost": scene.cost,
        "attitude_deg": {"roll": roll, "pitch": pitch, "yaw": yaw},
        "payload_error_m": scene.error_m,
        "phase": scene.phase,
        "step_ms": [None if a.report is None else float(a.report.times_ms[-1]) for a in scene.agents],
        "oldest_plan_s": max((link.age_s for link in scene.links if link.age_s is not None), default=None),
    }


def _object(title: str, properties: Json) -> Json:
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


_NUMBER, _MAYBE = {"type": "number"}, {"type": ["number", "null"]}
_NUMBERS = _object(
    NUMBERS,
    {
        "cost": _NUMBER,
        "attitude_deg": _object("roll, pitch, yaw", {"roll": _NUMBER, "pitch": _NUMBER, "yaw": _NUMBER}),
        "payload_error_m": _NUMBER,
        "phase": {"type": "string"},
        "step_ms": {"type": "array", "items": _MAYBE},
        "oldest_plan_s": _MAYBE,
    },
)


def to_json(message: Message) -> bytes:
    """Return a message as a JSON object."""
    content: Json = {}
    for name in _FIELDS[message.kind]:
        value = getattr(message, name)
        if name in _MATRICES:
            content[name], content[f"{name}_shape"] = value.reshape(-1), value.shape
        else:
            content[name] = value
    return orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)


def json_schema(kind: str) -> Json:
    """Return the JSON Schema of a kind of message, for viewers."""
    properties: Json = {}
    for name, hint in _FIELDS[kind].items():
        properties[name] = _type(hint)
        if name in _MATRICES:
            properties[f"{name}_shape"] = {"type": "array", "items": {"type": "integer"}}
    cls = KINDS[kind]
    return {"description": (cls.__doc__ or "").split("\n", 1)[0], **_object(cls.__name__, properties)}


def _type(hint: Any) -> Json:
    if hint == Array:
        return {"type": "array", "items": {"type": "number"}}
    if get_origin(hint) is Literal:
        return {"type": "string", "enum": list(get_args(hint))}
    if get_origin(hint) is tuple:
        return {"type": "array", "items": _type(get_args(hint)[0])}
    return {"type": _SCALARS[hint]}
