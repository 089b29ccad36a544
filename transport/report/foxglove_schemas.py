"""JSON schemas of the messages in `transport.report.foxglove`; lists of unused primitives are always empty."""

from typing import Any

NUMBERS = "transport.Numbers"

Schema = dict[str, Any]


def _object(title: str, **properties: Schema) -> Schema:
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


def _list(items: Schema) -> Schema:
    return {"type": "array", "items": items}


def _numbers(*names: str) -> dict[str, Schema]:
    return {name: {"type": "number"} for name in names}


_NUMBER: Schema = {"type": "number"}
_INTEGER: Schema = {"type": "integer", "minimum": 0}
_TEXT: Schema = {"type": "string"}
_SWITCH: Schema = {"type": "boolean"}
_MAYBE: Schema = {"type": ["number", "null"]}
_EMPTY: Schema = {"type": "array", "items": {"type": "object"}, "maxItems": 0}

_TIME = _object("time", sec=_INTEGER, nsec={**_INTEGER, "maximum": 999_999_999})
_DURATION = _object("duration", sec={"type": "integer"}, nsec={**_INTEGER, "maximum": 999_999_999})
_VECTOR = _object("foxglove.Vector3", **_numbers("x", "y", "z"))
_POINT = _object("foxglove.Point3", **_numbers("x", "y", "z"))
_QUATERNION = _object("foxglove.Quaternion", **_numbers("x", "y", "z", "w"))
_POSE = _object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_COLOUR = _object("foxglove.Color", **_numbers("r", "g", "b", "a"))
_POINTS = {"points": _list(_POINT), "color": _COLOUR, "colors": _list(_COLOUR), "indices": _list(_INTEGER)}

_ARROW = _object(
    "foxglove.ArrowPrimitive",
    pose=_POSE,
    **_numbers("shaft_length", "shaft_diameter", "head_length", "head_diameter"),
    color=_COLOUR,
)
_CYLINDER = _object(
    "foxglove.CylinderPrimitive", pose=_POSE, size=_VECTOR, **_numbers("bottom_scale", "top_scale"), color=_COLOUR
)
_LINE = _object(
    "foxglove.LinePrimitive",
    type={"type": "integer", "enum": [0, 1, 2]},
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_SWITCH,
    **_POINTS,
)
_TRIANGLES = _object("foxglove.TriangleListPrimitive", pose=_POSE, **_POINTS)
_LABEL = _object(
    "foxglove.TextPrimitive",
    pose=_POSE,
    billboard=_SWITCH,
    font_size=_NUMBER,
    scale_invariant=_SWITCH,
    color=_COLOUR,
    text=_TEXT,
)
_ENTITY = _object(
    "foxglove.SceneEntity",
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_DURATION,
    frame_locked=_SWITCH,
    metadata=_list(_object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
    arrows=_list(_ARROW),
    cubes=_EMPTY,
    spheres=_EMPTY,
    cylinders=_list(_CYLINDER),
    lines=_list(_LINE),
    triangles=_list(_TRIANGLES),
    texts=_list(_LABEL),
    models=_EMPTY,
)
_TRANSFORM = _object(
    "foxglove.FrameTransform",
    timestamp=_TIME,
    parent_frame_id=_TEXT,
    child_frame_id=_TEXT,
    translation=_VECTOR,
    rotation=_QUATERNION,
)

SCHEMAS: dict[str, Schema] = {
    "foxglove.FrameTransforms": _object("foxglove.FrameTransforms", transforms=_list(_TRANSFORM)),
    "foxglove.SceneUpdate": _object(
        "foxglove.SceneUpdate",
        deletions=_list(_object("foxglove.SceneEntityDeletion", timestamp=_TIME, type=_INTEGER, id=_TEXT)),
        entities=_list(_ENTITY),
    ),
    NUMBERS: _object(
        NUMBERS,
        cost=_NUMBER,
        attitude_deg=_object("roll, pitch, yaw", **_numbers("roll", "pitch", "yaw")),
        payload_error_m=_NUMBER,
        phase=_TEXT,
        step_ms=_list(_MAYBE),
        oldest_plan_s=_MAYBE,
    ),
}
