"""The attitude whose thrust has the direction of a force, at a given heading, and its derivatives."""

import math

import numpy as np

from transport.model.arrays import Array

_DOWN_I = np.array([0.0, 0.0, 1.0])


def roll_and_pitch(force_I: Array, yaw: float) -> tuple[float, float]:
    """Return roll and pitch whose thrust has the direction of a force, (3,), N, at a yaw, rad; level without a force.

    Source: docs/equations.md (31b).
    """
    x, y, z = (float(component) for component in force_I)
    strength = math.sqrt(x * x + y * y + z * z)
    if not strength > 0.0:
        return 0.0, 0.0

    forward, right = _along_heading(x, y, yaw)
    sine_of_roll = min(max(right / strength, -1.0), 1.0)  # beyond 1 by rounding
    return math.asin(sine_of_roll), math.atan2(-forward, -z)


def roll_and_pitch_slopes(force_I: Array, yaw: float) -> tuple[Array, Array]:
    """Return the derivatives of roll and pitch by the force, (2, 3), rad/N, and by the yaw, (2,).

    The force must not point along the axis to the right of the heading: the roll is 90 deg there, and
    the pitch undefined.
    Source: docs/equations.md (31g).
    """
    x, y, z = (float(component) for component in force_I)
    strength = math.sqrt(x * x + y * y + z * z)
    forward, right = _along_heading(x, y, yaw)
    forward_by_force = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    right_by_force = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    by_force = np.zeros((2, 3))
    by_yaw = np.zeros(2)

    # sin(roll) = right / strength, and cos(roll) = leaning / strength.
    leaning = math.sqrt(strength**2 - right**2)
    by_force[0] = (right_by_force - right / strength**2 * force_I) / leaning
    by_yaw[0] = -forward / leaning

    # tan(pitch) = forward / z
    by_force[1] = (z * forward_by_force - forward * _DOWN_I) / (forward**2 + z**2)
    by_yaw[1] = z * right / (forward**2 + z**2)
    return by_force, by_yaw


def _along_heading(x: float, y: float, yaw: float) -> tuple[float, float]:
    """Return the parts of a level vector along the heading and to its right."""
    cosine = math.cos(yaw)
    sine = math.sin(yaw)
    forward = cosine * x + sine * y
    right = cosine * y - sine * x
    return forward, right
