"""Bodies of a drawing: payload, quadrotor and obstacles as convex meshes."""

from collections.abc import Iterator
from itertools import product

import numpy as np

from transport.model.arrays import Array
from transport.model.physics.parameters import System, payload_half_size
from transport.protocol.scenario.setup.run_setup import Setup
from transport.scene.frames_and_poses import INERTIAL
from transport.scene.lines_meshes_and_labels import Colour, Mesh, ball, disc, prism, solid

DARK_GREY: Colour = (60, 60, 60)  # payload and front rotors
GREY: Colour = (90, 90, 90)  # rods and beams
_OBSTACLE: Colour = (196, 120, 60)

# Arm length, rotor radius, beam and body thickness of a drawn quadrotor, in parts of its span
# (rotor tip to rotor tip).
_ARM = 0.31
_ROTOR = 0.17
_BEAM = 0.02
_BODY = 0.06
_ROTOR_HALF_HEIGHT = 0.01  # same parts
_ROTOR_OPACITY = 0.6

# Thickness of the drawn payload, and its least half width, m.
_PLATE_M = 0.12
_CORE_M = 0.15

# Least size of an obstacle, m; half size of an endless one, and its reach beyond the maneuver, m.
_THIN_M = 0.02
_ENDLESS_M = 1e4
_BEYOND_M = 1.0
_OBSTACLE_OPACITY = 0.4

_SQUARE = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])


def payload_points(system: System, *, grounded: bool = False) -> Array:
    """Return the corners of a plate below all attachments, (V, 3), payload frame.

    On a ground it is the box there.
    """
    attachments = [uav.rho[:2] for uav in system.uavs]
    flat = np.vstack([attachments, _CORE_M * _SQUARE])
    top = float(np.mean([uav.rho[2] for uav in system.uavs]))
    bottom = float(payload_half_size(system)[2]) if grounded else top + _PLATE_M
    return prism(flat, top, bottom)


def quadrotor(frame: str, span: float, colour: Colour) -> Iterator[Mesh]:
    """Yield body, beams and rotors of a quadrotor of a span, m; its front rotors are dark."""
    angles = np.radians([45.0, 135.0, 225.0, 315.0])
    arms = np.column_stack([np.cos(angles), np.sin(angles)])

    hub = disc(2.0 * _BODY, -_BODY / 2.0, _BODY / 2.0)
    yield solid("hub", frame, span * hub, colour)

    for k in range(2):
        flat = (_SQUARE * (_ARM, _BEAM)) @ arms[k : k + 2]
        beam = prism(flat, -_BODY / 2.0, -_BODY / 2.0 - _BEAM)
        yield solid(f"beam{k}", frame, span * beam, GREY)

    for k, (x, y) in enumerate(_ARM * arms):
        middle = np.array([x, y, -_BODY])
        rotor = disc(_ROTOR, -_ROTOR_HALF_HEIGHT, _ROTOR_HALF_HEIGHT) + middle
        own = DARK_GREY if x > 0.0 else colour
        yield solid(f"rotor{k}", frame, span * rotor, own, opacity=_ROTOR_OPACITY)


def obstacles(setup: Setup, low: Array, high: Array) -> Iterator[Mesh]:
    """Yield the obstacles, inertial frame, m.

    Endless ones reach beyond a box with corners low and high, (3,).
    """
    beyond = np.array([_BEYOND_M, _BEYOND_M, 0.0])
    corners_I = _corners(low - beyond, high + beyond)
    solids = [part for obstacle in setup.obstacles for part in obstacle.solids]
    for k, part in enumerate(solids):
        # In the obstacle's own frame: its half size, and as much of the box as endless axes show.
        half = part.half
        is_endless = half > _ENDLESS_M
        corners = (corners_I - part.centre_I) @ part.R
        near = np.where(is_endless, np.maximum(corners.min(axis=0), -half), -half)
        shown = np.maximum(np.minimum(corners.max(axis=0), half), near + _THIN_M)
        far = np.where(is_endless, shown, half)

        points = _rounded(_corners(near, far), part.radius, is_column=bool(is_endless[2]))
        placed_I = points @ part.R.T + part.centre_I
        name = f"obstacle{k + 1}"
        yield solid(name, INERTIAL, placed_I, _OBSTACLE, opacity=_OBSTACLE_OPACITY)


def _corners(low: Array, high: Array) -> Array:
    """Return the corners of a box, (8, 3)."""
    return np.array(list(product(*zip(low, high, strict=True))))


def _rounded(corners: Array, radius: float, *, is_column: bool) -> Array:
    """Return points of a body with round corners, (V, 3): of a column about z, or all round."""
    around = np.zeros((1, 3))
    if radius:
        around = disc(radius, 0.0) if is_column else ball(radius)
    points = corners[:, None] + around
    return points.reshape(-1, 3)
