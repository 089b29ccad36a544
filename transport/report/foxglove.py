"""Copy of a log for Foxglove: messages as JSON, and channels for transforms, scene and numbers.

Transforms and scenes are Foxglove's own messages in protobuf. A matrix in JSON is written row by
row with its shape in a second field (`inputs`, `inputs_shape`): viewers plot `inputs[0]`, but few
plot a list of lists. A float64 is written with the fewest digits that read back as the same bits.
"""

from collections.abc import Container, Iterable
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
    Put,
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
_MATRICES = ("points", "uav_states", "inputs", "corrections", "arrivals")
_LINE_LIST = 2  # foxglove.LinePrimitive
_FIXED: Fields = {"scale_invariant": True}  # on the screen
_TEXT_SIZE = 14.0
_NS_PER_S = 10**9


def write_foxglove(builder: SceneBuilder, log: RunLog, out: Path) -> int:
    """Write the copy of a log, complete or cut, into a new file.

    Return the number of ticks with a scene.
    """
    with mcap_copy(out, log.header) as put:
        _write_messages(put, builder, log)
        return _write_scenes(put, builder)


def _write_messages(put: Put, builder: SceneBuilder, log: RunLog) -> None:
    """Write the messages of a log as JSON, at the times of their ticks."""
    period_ns = builder.setup.period_ns
    schemas = {
        kind: _json(f"transport.{cls.__name__}", orjson.dumps(json_schema(kind)))
        for kind, cls in KINDS.items()
    }
    for entry in log.messages:
        message = entry.message
        put(
            topic_of(message),
            schemas[message.kind],
            to_json(message),
            min(message.tick * period_ns, LAST_TIME_NS),
            published_ns=entry.received_ns,
            number=message.sequence % SEQUENCES,
        )


def _write_scenes(put: Put, builder: SceneBuilder) -> int:
    """Write transforms, parts of the scene and numbers of each tick; return the number of ticks."""
    numbers = _json(NUMBERS, Path(__file__).with_name("numbers.schema.json").read_bytes())
    drawing = Drawing(builder)
    ticks = sorted(builder.history.plant_states)
    shown: set[str] = set()
    for tick in ticks:
        at_ns = tick * builder.setup.period_ns
        scene = builder.at(tick)
        poses = drawing.poses(scene)
        transforms: Any = [_transform(*link, at_ns) for link in tree(poses)]
        put("/tf", _TRANSFORMS, FrameTransforms(transforms=transforms).SerializeToString(), at_ns)

        _put_parts(put, "now", drawing.moving(scene), at_ns)
        if tick == ticks[0]:
            flown = drawing.flown(builder.at(ticks[-1]))
            _put_parts(put, "paths", [flown], at_ns)
        # At the start, and when a UAV leaves or the payload touches the ground.
        if shown != poses.keys():
            shown = set(poses)
            _put_parts(put, "bodies", drawing.fixed, at_ns, shown)

        put("/numbers", numbers, orjson.dumps(_numbers(scene)), at_ns)
    return len(ticks)


def _put_parts(
    put: Put, name: str, parts: Iterable[Part], at_ns: int, shown: Container[str] | None = None
) -> None:
    """Write parts of the drawing; those in other frames than the shown ones are empty."""
    entities: Any = [
        _entity(part, at_ns, empty=shown is not None and part.frame not in shown) for part in parts
    ]
    put(f"/scene/{name}", _SCENE, SceneUpdate(entities=entities).SerializeToString(), at_ns)


def _json(name: str, schema: bytes) -> Schema:
    """Return the schema of messages in JSON."""
    return Schema(name, "jsonschema", schema, "json")


def _protobuf(message: type[Any]) -> Schema:
    """Return the schema of messages in protobuf."""
    content = build_file_descriptor_set(message).SerializeToString()
    return Schema(message.DESCRIPTOR.full_name, "protobuf", content, "protobuf")


_TRANSFORMS = _protobuf(FrameTransforms)
_SCENE = _protobuf(SceneUpdate)


def _entity(part: Part, at_ns: int, *, empty: bool = False) -> Fields:
    """Return a part of the drawing, which moves with its frame.

    The next part of its name replaces it.
    """
    entity = _stamp(at_ns) | {
        "frame_id": part.frame,
        "id": f"{part.frame}/{part.name}",
        "frame_locked": True,
    }
    if empty:
        return entity
    match part:
        case Lines():
            return entity | {"lines": [_lines(part)]}
        case Mesh():
            return entity | {"triangles": [_triangles(part)]}
        case Label():
            return entity | {"texts": [_text(part)]}


def _lines(part: Lines) -> Fields:
    """Return lines, each end with the colour of its line."""
    return _FIXED | {
        "type": _LINE_LIST,
        "points": _points(part.segments.reshape(-1, 3)),
        "colors": [colour_fields(colour) for colour in np.repeat(part.colours, 2, axis=0)],
        "thickness": part.width,
        "pose": pose_fields(),
    }


def _triangles(part: Mesh) -> Fields:
    """Return the faces of a mesh."""
    return {
        "points": _points(part.vertices),
        "indices": part.faces.reshape(-1).tolist(),
        "color": colour_fields(part.colour, part.opacity),
        "pose": pose_fields(),
    }


def _text(part: Label) -> Fields:
    """Return a text that faces the reader."""
    return _FIXED | {
        "color": colour_fields(part.colour),
        "billboard": True,
        "font_size": _TEXT_SIZE,
        "text": part.text,
        "pose": pose_fields(part.position),
    }


def _transform(parent: str, child: str, pose: FramePose, at_ns: int) -> Fields:
    """Return the pose of a frame in its parent."""
    place = pose_fields(*pose)
    return _stamp(at_ns) | {
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": place["position"],
        "rotation": place["orientation"],
    }


def _points(points: Array) -> list[Fields]:
    """Return points, (k, 3)."""
    return [point_fields(point) for point in points]


def _stamp(at_ns: int) -> Fields:
    """Return a time of the scenario."""
    return {"timestamp": {"seconds": at_ns // _NS_PER_S, "nanos": at_ns % _NS_PER_S}}


def _numbers(scene: Scene) -> Fields:
    """Return the numbers of a tick, as in numbers.schema.json."""
    roll, pitch, yaw = scene.attitude_deg.tolist()
    ages_s = [age_s for *_, age_s in scene.links if age_s is not None]
    steps_ms = [None if report is None else float(report.times_ms[-1]) for report in scene.reports]
    return {
        "cost": scene.cost,
        "attitude_deg": {"roll": roll, "pitch": pitch, "yaw": yaw},
        "payload_error_norm_m": scene.error_m,
        "phase": scene.phase,
        "step_ms": steps_ms,
        "oldest_plan_s": max(ages_s, default=None),
    }


def to_json(message: Message) -> bytes:
    """Return a message as a JSON object."""
    content: Fields = {}
    for name in message.__struct_fields__:
        value = getattr(message, name)
        if name in _MATRICES:
            content[name] = value.reshape(-1)
            content[f"{name}_shape"] = value.shape
        elif name == "targets":  # bytes of messages
            content[name] = [one.hex() for one in value]
        else:
            content[name] = value
    return orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)


def json_schema(kind: str) -> Fields:
    """Return the JSON Schema of a kind of message, for viewers."""
    cls = KINDS[kind]
    properties: Fields = {}
    for name, hint in get_type_hints(cls).items():
        if name in cls.__struct_fields__:
            written = list[float] if hint == Array else hint
            properties[name] = TypeAdapter(written).json_schema()
        if name in _MATRICES:
            properties[f"{name}_shape"] = TypeAdapter(list[int]).json_schema()

    description, *_ = (cls.__doc__ or "").split("\n", 1)
    return {
        "title": cls.__name__,
        "description": description,
        "type": "object",
        "properties": properties,
        "required": list(properties),
    }
