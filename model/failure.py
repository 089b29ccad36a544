"""Motor-off and released UAVs in the state and the parameters of the whole team.

The layout of state and input stays that of N UAVs. A motor-off UAV keeps mass and rod and has no inputs. A released
UAV is replaced at the end of its rod by a bob of negligible mass that hangs below its attachment point.
"""

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
    """Return the system with bobs of `RELEASED_MASS_KG` in place of released UAVs, 0-based.

    A bob keeps the UAV's inertia, which has no effect without moment and rotation. Source: docs/equations.md (50).
    """
    uavs = [replace(uav, mass=RELEASED_MASS_KG) if i in released else uav for i, uav in enumerate(system.uavs)]
    return replace(system, uavs=tuple(uavs))


def failed_model(system: System, off: Collection[int], released: Collection[int]) -> Model:
    """Return the model of a team with motor failures, as in `failed_hover`. Source: docs/equations.md (50)."""
    return Model(with_released(system, released), off=off, released=released)


def failed_hover(
    system: System, off: Collection[int], released: Collection[int], thrusts: Mapping[int, float] | None = None
) -> Hover:
    """Return the hover of a team some of whose UAVs have no motors, the payload level.

    A motor-off UAV stands upright on its rod, as at the moment of failure; its weight on the payload is the same below.

    Args:
        system: Physical parameters of the whole team.
        off: UAVs without motors, 0-based, the released ones among them.
        released: UAVs cut loose, 0-based.
        thrusts: Fixed thrusts of the UAVs left to the fail-safe, N, by UAV, 0-based.
    Raises: ParameterError: the remaining UAVs cannot hold the payload.
    Source: docs/equations.md (51).
    """
    rods = np.tile([0.0, 0.0, 1.0], (system.N, 1))
    rods[sorted(released)] *= -1.0
    given = {**(thrusts or {}), **dict.fromkeys(off, 0.0)}
    return hover(with_released(system, released), rods, given)


def motor_off_state(x: Array, uav: int) -> Array:
    """Return the state with the rotation of a UAV, 0-based, stopped, (n,).

    Without thrust its attitude has no effect, but an undamped rotation would reach the singularity of docs/equations.md
    (3).
    """
    x = x.copy()
    x[state.uav_slice(uav)][state.OMEGA] = 0.0
    return x


def released_state(x: Array, uav: int) -> Array:
    """Return the state with a bob at rest below the attachment point of a UAV, 0-based, (n,).

    Source: docs/equations.md (50).
    """
    x = x.copy()
    block = x[state.uav_slice(uav)]
    block[:] = 0.0
    block[state.E] = -rotation(x[state.THETA0])[2]  # minus the inertial z axis in the payload frame
    return x


def no_inputs(u: Array, uavs: Collection[int]) -> Array:
    """Return inputs, (..., m), with those of some UAVs, 0-based, zero."""
    u = u.copy()
    u[..., state.input_indices(sorted(uavs))] = 0.0
    return np.asarray(u)
