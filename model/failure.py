"""UAVs without motors, and of these released ones, with bobs in their place: docs/equations.md (50), (51)."""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from model import state
from model.arrays import Array
from model.hover import Hover, hover
from model.linearisation import Model
from model.parameters import System
from model.rotations import rotation

# The bob pulls with 1e-5 N. The equations of motion divide by a mass only where a thrust or force acts on it.
RELEASED_MASS_KG = 1e-6


def with_released(system: System, released: Collection[int]) -> System:
    """Return the system with bobs in place of released UAVs; they keep the inertia, which has no effect."""
    uavs = [replace(uav, mass=RELEASED_MASS_KG) if i in released else uav for i, uav in enumerate(system.uavs)]
    return replace(system, uavs=tuple(uavs))


def failed_model(system: System, off: Collection[int], released: Collection[int]) -> Model:
    """Return the model of a team with motor failures."""
    return Model(with_released(system, released), off=off, released=released)


def failed_hover(
    system: System, off: Collection[int], released: Collection[int], thrusts: Mapping[int, float] | None = None
) -> Hover:
    """Return the hover with UAVs off, upright, and given thrusts of others, N. Raises: ParameterError: none."""
    rods = np.tile([0.0, 0.0, 1.0], (system.N, 1))
    rods[sorted(released)] *= -1.0
    given = {**(thrusts or {}), **dict.fromkeys(off, 0.0)}
    return hover(with_released(system, released), rods, given)


def motor_off_state(x: Array, uav: int) -> Array:
    """Return the state with the rotation of a UAV stopped, (n,): undamped it would reach the singularity of (3)."""
    x = x.copy()
    x[state.uav_slice(uav)][state.OMEGA] = 0.0
    return x


def released_state(x: Array, uav: int) -> Array:
    """Return the state with a bob at rest below the attachment point of a UAV, (n,)."""
    x = x.copy()
    block = x[state.uav_slice(uav)]
    block[:] = 0.0
    block[state.E] = -rotation(x[state.THETA0])[2]  # minus the inertial z axis in the payload frame
    return x


def no_inputs(u: Array, uavs: Collection[int]) -> Array:
    """Return inputs, (..., m), with those of some UAVs zero."""
    u = u.copy()
    u[..., state.input_indices(sorted(uavs))] = 0.0
    return np.asarray(u)
