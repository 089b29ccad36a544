"""The box that a payload is taken for where it touches the ground; the equations of motion know no shape."""

import numpy as np

from model.arrays import Array
from model.parameters import System

# Least half length of each edge, m.
_LEAST_M = 0.05


def payload_half_size(system: System) -> Array:
    """Return half the edges of the payload's box, (3,), m: about its centre of mass, as far as its attachment points.

    Edges are parallel to the axes of the payload frame.
    """
    rho = np.array([uav.rho for uav in system.uavs])
    return np.asarray(np.maximum(np.abs(rho).max(axis=0), _LEAST_M))


def payload_corners(system: System) -> Array:
    """Return the corners of the payload's box, (8, 3), payload frame, m."""
    signs = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    return signs * payload_half_size(system)


def resting_height(system: System, ground_m: float) -> float:
    """Return z of the centre of mass of a level payload on the ground, inertial frame (z down), m."""
    return ground_m - float(payload_half_size(system)[2])
