"""Copy of a log for Foxglove.

Messages as JSON, and additional channels for transforms, 3D scene and numbers.

Transforms and scenes are Foxglove's own messages in protobuf. A matrix in JSON is written row by
row with its shape in
a second field (`inputs`, `inputs_shape`): viewers plot `inputs[0]`, but few plot a list of lists. A
float64 is written with the fewest digits that read back as the same bits.
"""

from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import orjson
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap_protobuf.schema import build_file_descriptor_set
from pydantic import TypeAdapter

from transport.log.run_log import RunLog, topic_of
from transport.log.writer import LAST_TIME_NS, SEQUENCES
from transport.model.arrays import Array
from transport.protocol.wire.messages import KINDS, Message
from transport.report.mcap_copy import (
    Fields,
    Schema,
    colour_fields,
    mcap_copy,
    point_fields,
    pose_fields,
)
from transport.scene.drawing import Drawing, tree
from transport.scene.parts import Label, Lines, Mesh, Part
from transport.scene.parts import Pose as FramePose
from transport.scene.scene import Scene, SceneBuilder

NUMBERS = "transport.Numbers"
# Array fields with two axes; all others have one.
_MATRICES = ("points", "uav_states", "inputs", "corrections")
_LINE_LIST = 2  # foxglove.LinePrimitive
_FIXED: Fields = {"scale_invariant": True}  # on the screen


def write_foxglove(builder: SceneBuilder, log: RunLog, out: Path) -> int:
    """Write the copy of a log, complete or cut, into a new file.

    Return the number of ticks with a scene.
    """
    period_ns = builder.setup.period_ns
    schemas = {
        kind: _json(f"transport.{cls.__name__}", orjson.dumps(json_schema(kind)))
        for kind, cls in KINDS.items()
    }
    numbers = _json(NUMBERS, Path(__file__).with_name("numbers.schema.json").read_bytes())
    with mcap_copy(out, log.header) as put:
        for entry in log.messages:
            message, at_ns = entry.message, min(entry.message.tick * period_ns, LAST_TIME_NS)
            content, number = to_json(message), message.sequence % SEQUENCES
            put(topic_of(message), schemas[message.kind], content, at_ns, entry.received_ns, number)
        drawing, ticks, shown = Drawing(builder), sorted(builder.history.plant_states), set[str]()
        for tick in ticks:
            scene, at_ns = builder.at(tick), tick * period_ns
            poses = drawing.poses(scene)
            transforms: Any = [_transform(*link, at_ns) for link in tree(poses)]
            put(
                "/tf",
                _TRANSFORMS,
                FrameTransforms(transforms=transforms).SerializeToString(),
                at_ns,
            )
            entities: dict[str, Any] = {
                "now": [_entity(part, at_ns) for part in drawing.moving(scene)]
            }
            if tick == ticks[0]:
                entities["paths"] = [_entity(drawing.flown(builder.at(ticks[-1])), at_ns)]
            if (
                shown != poses.keys()
            ):  # at the start, and when a UAV leaves or the payload touches the ground
                shown = set(poses)
                entities["bodies"] = [
                    _entity(part, at_ns, empty=part.frame not in shown) for part in drawing.fixed
                ]
            for name, parts in entities.items():
                put(
                    f"/scene/{name}", _SCENE, SceneUpdate(entities=parts).SerializeToString(), at_ns
                )
            put("/numbers", numbers, orjson.dumps(_numbers(scene)), at_ns)
    return len(ticks)


def _json(name: str, schema: bytes) -> Schema:
    return Schema(name, "jsonschema", schema, "json")


def _protobuf(message: type[Any]) -> Schema:
    content = build_file_descriptor_set(message).SerializeToString()
    return Schema(message.DESCRIPTOR.full_name, "protobuf", content, "protobuf")


_TRANSFORMS, _SCENE = _protobuf(FrameTransforms), _protobuf(SceneUpdate)


def _entity(part: Part, at_ns: int, *, empty: bool = False) -> Fields:
    """Return a part of the drawing, which moves with its frame and is replaced by the next of its name."""
    entity = _at(at_ns) | {
        "frame_id": part.frame,
        "id": f"{part.frame}/{part.name}",
        "frame_locked": True,
    }
    match part:
        case _ if empty:
            return entity
        case Lines():
            colours = [colour_fields(colour) for colour in np.repeat(part.colours, 2, axis=0)]
            shape = {
                "type": _LINE_LIST,
                "points": _points(part.segments.reshape(-1, 3)),
                "colors": colours,
            }
            return entity | {
                "lines": [_FIXED | shape | {"thickness": part.width, "pose": pose_fields()}]
            }
        case Mesh():
            shape = {"points": _points(part.vertices), "indices": part.faces.reshape(-1).tolist()}
            colour = colour_fields(part.colour, part.opacity)
            return entity | {"triangles": [shape | {"color": colour, "pose": pose_fields()}]}
        case Label():
            style: Fields = {
                "color": colour_fields(part.colour),
                "billboard": True,
                "font_size": 14.0,
            }
            return entity | {
                "texts": [_FIXED | style | {"text": part.text, "pose": pose_fields(part.position)}]
            }


def _transform(parent: str, child: str, pose: FramePose, at_ns: int) -> Fields:
    place = pose_fields(*pose)
    frames = {"parent_frame_id": parent, "child_frame_id": child}
    return (
        _at(at_ns) | frames | {"translation": place["position"], "rotation": place["orientation"]}
    )


def _points(points: Array) -> list[Fields]:
    return [point_fields(point) for point in points]


def _at(at_ns: int) -> Fields:
    return {"timestamp": {"seconds": at_ns // 10**9, "nanos": at_ns % 10**9}}


def _numbers(scene: Scene) -> Fields:
    return {
        "cost": scene.cost,
        "attitude_deg": dict(
            zip(("roll", "pitch", "yaw"), scene.attitude_deg.tolist(), strict=True)
        ),
        "payload_error_norm_m": scene.error_m,
        "phase": scene.phase,
        "step_ms": [
            None if report is None else float(report.times_ms[-1]) for report in scene.reports
        ],
        "oldest_plan_s": max(
            (age_s for *_, age_s in scene.links if age_s is not None), default=None
        ),
    }


def to_json(message: Message) -> bytes:
    """Return a message as a JSON object."""
    content: Fields = {}
    for name in message.__struct_fields__:
        content[name] = getattr(message, name)
        if name in _MATRICES:
            content[name], content[f"{name}_shape"] = content[name].reshape(-1), content[name].shape
    return orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)


def json_schema(kind: str) -> Fields:
    """Return the JSON Schema of a kind of message, for viewers."""
    cls, properties = KINDS[kind], Fields()
    for name, hint in get_type_hints(cls).items():
        if name in cls.__struct_fields__:
            properties[name] = TypeAdapter(list[float] if hint == Array else hint).json_schema()
        if name in _MATRICES:
            properties[f"{name}_shape"] = TypeAdapter(list[int]).json_schema()
    about = {
        "title": cls.__name__,
        "description": (cls.__doc__ or "").split("\n", 1)[0],
        "type": "object",
    }
    return about | {"properties": properties, "required": list(properties)}
