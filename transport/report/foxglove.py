"""Copy of a log for Foxglove: messages as JSON, and additional channels for transforms, 3D scene and numbers.

Transforms and scenes are Foxglove's own messages in protobuf. A matrix in JSON is written row by row with its shape in
a second field (`inputs`, `inputs_shape`): viewers plot `inputs[0]`, but few plot a list of lists. A float64 is written
with the fewest digits that read back as the same bits.
"""

from collections.abc import Iterable
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
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.schema import build_file_descriptor_set

from model.arrays import Array
from protocol.wire.messages import KINDS, Message
from transport.log.run_log import RunLog, topic_of
from transport.log.writer import LAST_TIME_NS, SEQUENCES
from transport.report.mcap_copy import Schema, mcap_copy
from transport.scene.drawing import Drawing, Label, Lines, Mesh, Part, quaternion, tree
from transport.scene.drawing import Pose as FramePose
from transport.scene.scene import Scene, SceneBuilder

# Most times at which the actual paths are written, which are long.
_PATHS = 100

NUMBERS = "transport.Numbers"
# Array fields with two axes; all others have one.
_MATRICES = ("points", "uav_states", "inputs", "corrections")
_SCALARS = {str: "string", int: "integer", float: "number", bool: "boolean"}

Json = dict[str, Any]


def write_foxglove(builder: SceneBuilder, log: RunLog, out: Path) -> int:
    """Write the copy of a log, complete or cut, into a new file; return the number of ticks with a scene.

    Raises: OSError: it cannot be written.
    """
    period_ns = builder.setup.period_ns
    schemas = {kind: _json(f"transport.{cls.__name__}", json_schema(kind)) for kind, cls in KINDS.items()}
    numbers = _json(NUMBERS, _NUMBERS)
    with mcap_copy(out, log.header) as copy:
        for message, received_ns in ((entry.message, entry.received_ns) for entry in log.messages):
            topic, at_ns = topic_of(message), min(message.tick * period_ns, LAST_TIME_NS)
            sequence = message.sequence % SEQUENCES
            copy.put(topic, schemas[message.kind], to_json(message), at_ns, received_ns, sequence)
        drawing, ticks = Drawing(builder), sorted(builder.history.plant_states)
        every, shown = max(1, len(ticks) // _PATHS), set[str]()
        for number, tick in enumerate(ticks):
            scene, at_ns = builder.at(tick), tick * period_ns
            poses = drawing.poses(scene)
            transforms = [_transform(*link, at_ns) for link in tree(poses)]
            copy.put("/tf", _TRANSFORMS, FrameTransforms(transforms=transforms).SerializeToString(), at_ns)
            scenes = {"now": drawing.moving(scene, flown=False)}
            if number % every == 0 or tick == ticks[-1]:
                scenes["paths"] = iter([drawing.flown(scene)])
            entities = {name: [_entity(part, at_ns) for part in parts] for name, parts in scenes.items()}
            if shown != poses.keys():  # at the start, and when a UAV leaves or the payload touches the ground
                shown = set(poses)
                entities["bodies"] = [_entity(part, at_ns, empty=part.frame not in shown) for part in drawing.fixed]
            for name, parts in entities.items():
                copy.put(f"/scene/{name}", _SCENE, SceneUpdate(entities=parts).SerializeToString(), at_ns)
            copy.put("/numbers", numbers, orjson.dumps(_numbers(scene)), at_ns)
    return len(ticks)


def _json(name: str, schema: Json) -> Schema:
    return Schema(name, "jsonschema", orjson.dumps(schema), "json")


def _protobuf(message: type[Any]) -> Schema:
    content = build_file_descriptor_set(message).SerializeToString()
    return Schema(message.DESCRIPTOR.full_name, "protobuf", content, "protobuf")


_TRANSFORMS, _SCENE = _protobuf(FrameTransforms), _protobuf(SceneUpdate)


def _entity(part: Part, at_ns: int, *, empty: bool = False) -> SceneEntity:
    """Return a part of the drawing, which moves with its frame and is replaced by the next of its name."""
    name = f"{part.frame}/{part.name}"
    entity = SceneEntity(timestamp=_time(at_ns), frame_id=part.frame, id=name, frame_locked=True)
    match part:
        case _ if empty:
            pass
        case Lines():
            entity.lines.add(
                type=LinePrimitive.LINE_LIST,
                pose=_pose(np.zeros(3)),
                thickness=part.width,
                scale_invariant=True,
                points=_points(part.segments.reshape(-1, 3)),
                colors=[_colour(colour) for colour in np.repeat(part.colours, 2, axis=0)],
            )
        case Mesh():
            entity.triangles.add(
                pose=_pose(np.zeros(3)),
                points=_points(part.vertices),
                color=_colour(part.colour, part.opacity),
                indices=part.faces.reshape(-1).tolist(),
            )
        case Label():
            entity.texts.add(
                pose=_pose(part.position),
                billboard=True,
                font_size=14.0,
                scale_invariant=True,
                color=_colour(part.colour),
                text=part.text,
            )
    return entity


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
    return Pose(
        position=Vector3(**dict(zip("xyz", position.tolist(), strict=True))), orientation=Quaternion(x=x, y=y, z=z, w=w)
    )


def _points(points: Array) -> list[Point3]:
    return [Point3(x=x, y=y, z=z) for x, y, z in points.tolist()]


def _colour(colour: Iterable[float], opacity: float = 1.0) -> Color:
    r, g, b = (channel / 255.0 for channel in colour)
    return Color(r=r, g=g, b=b, a=opacity)


def _time(at_ns: int) -> Timestamp:
    return Timestamp(seconds=at_ns // 10**9, nanos=at_ns % 10**9)


def _numbers(scene: Scene) -> Json:
    return {
        "cost": scene.cost,
        "attitude_deg": dict(zip(("roll", "pitch", "yaw"), scene.attitude_deg.tolist(), strict=True)),
        "payload_error_m": scene.error_m,
        "phase": scene.phase,
        "step_ms": [None if report is None else float(report.times_ms[-1]) for report in scene.reports],
        "oldest_plan_s": max((link.age_s for link in scene.links if link.age_s is not None), default=None),
    }


def _object(title: str, properties: Json) -> Json:
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


_NUMBER, _MAYBE = {"type": "number"}, {"type": ["number", "null"]}
_NUMBERS = _object(
    NUMBERS,
    {
        "cost": _NUMBER,
        "attitude_deg": _object("roll, pitch, yaw", dict.fromkeys(("roll", "pitch", "yaw"), _NUMBER)),
        "payload_error_m": _NUMBER,
        "phase": {"type": "string"},
        "step_ms": {"type": "array", "items": _MAYBE},
        "oldest_plan_s": _MAYBE,
    },
)


def to_json(message: Message) -> bytes:
    """Return a message as a JSON object."""
    content: Json = {}
    for name in message.__struct_fields__:
        content[name] = getattr(message, name)
        if name in _MATRICES:
            content[name], content[f"{name}_shape"] = content[name].reshape(-1), content[name].shape
    return orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)


def json_schema(kind: str) -> Json:
    """Return the JSON Schema of a kind of message, for viewers."""
    cls, properties = KINDS[kind], Json()
    for name, hint in get_type_hints(cls).items():
        if name in cls.__struct_fields__:
            properties[name] = _type(hint)
        if name in _MATRICES:
            properties[f"{name}_shape"] = _type(tuple[int, ...])
    return {"description": (cls.__doc__ or "").split("\n", 1)[0], **_object(cls.__name__, properties)}


def _type(hint: Any) -> Json:
    if hint == Array:
        return {"type": "array", "items": {"type": "number"}}
    if get_origin(hint) is Literal:
        return {"type": "string", "enum": list(get_args(hint))}
    if get_origin(hint) is tuple:
        return {"type": "array", "items": _type(get_args(hint)[0])}
    return {"type": _SCALARS[hint]}
