"""3-2-1 Euler angles and their rates, and the cross product, for NumPy arrays and CasADi expressions.

In the names c and s are cosine and sine, r, p and y roll, pitch and yaw.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from transport.model.arrays import Array


def rotation(Theta: Any) -> Any:
    """Return R = Rz(yaw) Ry(pitch) Rx(roll), body to outer coordinates, (3, 3).

    Theta: roll, pitch, yaw, (3,), rad. Source: docs/equations.md (2).
    """
    functions = _functions(Theta)
    cr, cp, cy = functions.each(functions.cos, Theta)
    sr, sp, sy = functions.each(functions.sin, Theta)

    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return functions.matrix(rows)


def euler_rates(Theta: Any) -> Any:
    """Return E, (3, 3), with Theta' = E omega for body rates omega.

    Singular at a pitch of +-90 deg. Source: docs/equations.md (3).
    """
    functions = _functions(Theta)
    cr, cp, _ = functions.each(functions.cos, Theta)
    sr, sp, _ = functions.each(functions.sin, Theta)
    tan_pitch = sp / cp

    rows = [
        [1.0, sr * tan_pitch, cr * tan_pitch],
        [0.0, cr, -sr],
        [0.0, sr / cp, cr / cp],
    ]
    return functions.matrix(rows)


def cross(a: Array, b: Array) -> Array:
    """Return a x b, (3,), at a tenth of the time that numpy.cross takes for single vectors."""
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def euler_angles(R: Array) -> Array:
    """Return roll, pitch, yaw, (..., 3), rad, of matrices, (..., 3, 3).

    The inverse of `rotation`, pitch in +-pi/2. Source: docs/equations.md (2).
    """
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = -np.arcsin(np.clip(R[..., 2, 0], -1.0, 1.0))
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])

    # At exactly 90 deg of pitch only yaw -+ roll is defined and these entries vanish: roll is set
    # to zero.
    is_locked = (R[..., 2, 1] == 0.0) & (R[..., 2, 2] == 0.0)
    roll = np.where(is_locked, 0.0, roll)
    yaw = np.where(is_locked, np.arctan2(-R[..., 0, 1], R[..., 1, 1]), yaw)
    return np.stack([roll, pitch, yaw], axis=-1)


class _Functions(NamedTuple):
    """The functions that NumPy and CasADi name differently."""

    cos: Callable[[Any], Any]
    sin: Callable[[Any], Any]
    each: Callable[[Callable[[Any], Any], Any], list[Any]]  # a function of each of three values
    matrix: Callable[[Any], Any]  # from rows of scalars


def _each_expression(function: Callable[[Any], Any], Theta: Any) -> list[Any]:
    return [function(Theta[axis]) for axis in range(3)]


def _each_number(function: Callable[[Any], Any], Theta: Any) -> list[Any]:
    # Products of floats take a tenth of the time of those of NumPy's scalars, with the same bits.
    values: list[Any] = function(Theta).tolist()
    return values


_EXPRESSIONS = (ca.SX, ca.MX, ca.DM)
_SYMBOLIC = _Functions(cos=ca.cos, sin=ca.sin, each=_each_expression, matrix=ca.blockcat)
_NUMERIC = _Functions(cos=np.cos, sin=np.sin, each=_each_number, matrix=np.array)


def _functions(value: Any) -> _Functions:
    """Return the functions for a value's type."""
    return _SYMBOLIC if isinstance(value, _EXPRESSIONS) else _NUMERIC
