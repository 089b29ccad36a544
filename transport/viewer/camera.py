"""Places of a camera from which a set of points fills the view."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array

# Vertical field of view, rad.
FIELD_OF_VIEW = 0.75
# Width over height of a page that has not told its size: that of a narrow window.
ASPECT = 1.0
# Part of the view that the points may fill; the rest is margin, for rotors and names.
_FILLED = 0.85
# Least distance from the middle of the points, m.
_LEAST_M = 2.0
_UP = np.array([0.0, 0.0, -1.0])  # the inertial frame points down


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Place of a camera and the point that it looks at, (3,) each, inertial frame, m."""

    position_I: Array
    look_at_I: Array


def camera_that_sees(
    points_I: Array, towards_camera: Iterable[float], *, aspect: float = ASPECT
) -> Camera:
    """Return the nearest camera in a direction that has all points in its view.

    With a point at (a, b, c) along the axes of the camera from the middle of the points, to the
    right, up and towards the camera, a camera at distance D sees it if
    |a| <= (D - c) tan(fov / 2) aspect and |b| <= (D - c) tan(fov / 2).

    Args:
        points_I: Points to be seen, (k, 3), k > 0, inertial frame, m.
        towards_camera: Direction from the points to the camera, (3,), not vertical.
        aspect: Width of the view over its height.
    """
    middle_I = (points_I.min(axis=0) + points_I.max(axis=0)) / 2.0

    backwards = np.asarray(tuple(towards_camera), float)
    backwards = backwards / np.linalg.norm(backwards)
    right = np.cross(_UP, backwards)
    right = right / np.linalg.norm(right)
    upwards = np.cross(backwards, right)

    offsets_I = points_I - middle_I
    a = offsets_I @ right
    b = offsets_I @ upwards
    c = offsets_I @ backwards

    slope = _FILLED * math.tan(FIELD_OF_VIEW / 2.0)
    distance_m = float(np.max(c + np.maximum(np.abs(a) / (slope * aspect), np.abs(b) / slope)))
    distance_m = max(distance_m, _LEAST_M)
    return Camera(position_I=middle_I + distance_m * backwards, look_at_I=middle_I)
