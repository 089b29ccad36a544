"""3-2-1 Euler angles (roll, pitch, yaw) and their rates, for numpy arrays and CasADi expressions."""

from typing import Any

import casadi as ca
import numpy as np

from transport.model.arrays import Array


def rotation(Theta: Any) -> Any:
    """Return R = Rz(yaw) Ry(pitch) Rx(roll), body to outer coordinates, (3, 3), of roll, pitch, yaw, (3,), rad: (2)."""
    cos, sin, matrix = _functions(Theta)
    cr, cp, cy = cos(Theta[0]), cos(Theta[1]), cos(Theta[2])
    sr, sp, sy = sin(Theta[0]), sin(Theta[1]), sin(Theta[2])
    return matrix([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ])  # fmt: skip


def euler_rates(Theta: Any) -> Any:
    """Return E, (3, 3), with Theta' = E omega for body rates omega.

    Singular at pitch = +-90 deg: equations.md (3).
    """
    cos, sin, matrix = _functions(Theta)
    cr, cp = cos(Theta[0]), cos(Theta[1])
    sr, sp = sin(Theta[0]), sin(Theta[1])
    tp = sp / cp
    return matrix([[1.0, sr * tp, cr * tp], [0.0, cr, -sr], [0.0, sr / cp, cr / cp]])


def euler_angles(R: Array) -> Array:
    """Return roll, pitch, yaw, (..., 3), rad, of matrices, (..., 3, 3).

    The inverse of `rotation`, pitch in +-pi/2.
    """
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = -np.arcsin(np.clip(R[..., 2, 0], -1.0, 1.0))
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    # At exactly 90 deg of pitch only yaw -+ roll is defined and these entries vanish: roll is set
    # to zero.
    locked = (R[..., 2, 1] == 0.0) & (R[..., 2, 2] == 0.0)
    roll = np.where(locked, 0.0, roll)
    yaw = np.where(locked, np.arctan2(-R[..., 0, 1], R[..., 1, 1]), yaw)
    return np.stack([roll, pitch, yaw], axis=-1)


def _functions(like: Any) -> tuple[Any, Any, Any]:
    return (
        (ca.cos, ca.sin, ca.blockcat)
        if isinstance(like, ca.SX | ca.MX | ca.DM)
        else (np.cos, np.sin, np.array)
    )
