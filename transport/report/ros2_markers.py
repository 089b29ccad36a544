"""Fields of ROS 2: points, poses, colours, and markers (visualization_msgs/msg/Marker) of a drawing."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from transport.model.arrays import Array
from transport.scene.frames_and_poses import INERTIAL
from transport.scene.lines_meshes_and_labels import Label, LineSegments, Mesh, Part, quaternion

# Fields of a message by name.
Fields = dict[str, Any]

# Types of markers, and the action that deletes one, of visualization_msgs/msg/Marker.
_LINE_LIST = 5
_TEXT = 9
_TRIANGLES = 11
_DELETE = 2
# Width of a drawn line per pixel of the viewer, and height of names, m.
_LINE_M = 0.004
_TEXT_M = 0.12
_NS_PER_S = 10**9
_ORIGIN = np.zeros(3)
_LEVEL = np.eye(3)
_BRIGHTEST = 255.0


def point_fields(point: Array) -> Fields:
    """Return a point or vector, (3,), as ROS 2 has it."""
    return dict(zip("xyz", point.tolist(), strict=True))


def pose_fields(position: Array = _ORIGIN, R: Array = _LEVEL) -> Fields:
    """Return a position, (3,), m, and a rotation, (3, 3), as ROS 2 has them."""
    orientation = dict(zip("wxyz", quaternion(R).tolist(), strict=True))
    return {"position": point_fields(position), "orientation": orientation}


def colour_fields(colour: Iterable[float], opacity: float = 1.0) -> Fields:
    """Return a colour, 0..255, as ROS 2 has it."""
    red, green, blue = (float(channel) / _BRIGHTEST for channel in colour)
    return {"r": red, "g": green, "b": blue, "a": float(opacity)}


def stamped(at_ns: int, frame: str = INERTIAL) -> Fields:
    """Return the header of a message at a time in a frame."""
    stamp = {"sec": at_ns // _NS_PER_S, "nanosec": at_ns % _NS_PER_S}
    return {"header": {"stamp": stamp, "frame_id": frame}}


def marker_fields(part: Part, at_ns: int, frames: Mapping[str, Any]) -> Fields:
    """Return a part as a marker, which moves with its frame.

    One without a frame, as of a UAV that left, is deleted.
    """
    marker = stamped(at_ns, part.frame) | {"ns": f"{part.frame}/{part.name}", "frame_locked": True}
    if part.frame not in frames:
        return marker | {"action": _DELETE}
    match part:
        case LineSegments():
            return marker | _lines(part)
        case Label():
            return marker | _text(part)
        case Mesh():
            return marker | _triangles(part)


def _lines(part: LineSegments) -> Fields:
    """Return the fields of lines, each end with the colour of its line."""
    return {
        "type": _LINE_LIST,
        "points": [point_fields(point) for point in part.segments.reshape(-1, 3)],
        "colors": [colour_fields(colour) for colour in np.repeat(part.colours, 2, axis=0)],
        "scale": point_fields(np.full(3, part.width * _LINE_M)),
        "pose": pose_fields(),
        "color": colour_fields((0, 0, 0)),
    }


def _text(part: Label) -> Fields:
    """Return the fields of a name."""
    return {
        "type": _TEXT,
        "text": part.text,
        "scale": point_fields(np.full(3, _TEXT_M)),
        "pose": pose_fields(part.position),
        "color": colour_fields(part.colour),
    }


def _triangles(part: Mesh) -> Fields:
    """Return the fields of a mesh."""
    corners = part.vertices[part.faces.reshape(-1)]
    return {
        "type": _TRIANGLES,
        "points": [point_fields(corner) for corner in corners],
        "scale": point_fields(np.ones(3)),
        "pose": pose_fields(),
        "color": colour_fields(part.colour, part.opacity),
    }
