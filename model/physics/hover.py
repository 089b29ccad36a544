"""Hover, the equilibrium at start and end of a maneuver, also of teams with failed UAVs.

Source: docs/equations.md (18), (19), (50), (51).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from transport.model import state
from transport.model.arrays import Array, ArrayLike, frozen
from transport.model.physics.parameters import ParameterError, System
from transport.model.physics.rotations import euler_angles, rotation

# Force and moment that may stay unbalanced, relative to the payload's weight (and 1 m): rounding,
# not physics.
_BALANCE_TOLERANCE = 1e-9
# A released UAV becomes a bob that pulls with 1e-5 N. The equations divide by a mass only where a
# force acts on it.
RELEASED_MASS_KG = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Hover:
    """The equilibrium with the payload level at the inertial origin."""

    x: Array  # state, (12 + 12 N,), SI
    u: Array  # input, (4 N,), SI
    tensions: Array  # of the rods, (N,), N


def hover(
    system: System, rods_P: ArrayLike | None = None, thrusts: Mapping[int, float] | None = None
) -> Hover:
    """Return the equilibrium with rod directions, (N, 3), payload frame, straight down by default.

    Rod tensions are of least norm: (18). `thrusts` gives the thrusts of some UAVs, N, by 0-based
    number. Their rods must be vertical; their tensions are T = (f - m g) (e . k), (51) for f = 0.
    Raises: ParameterError: no rod tensions balance the payload, a UAV would have to push down, or the
        rod of a given thrust is not vertical.
    Source: docs/equations.md (18)-(19), (51).
    """
    down = np.array([0.0, 0.0, 1.0])
    e = np.tile(down, (system.N, 1)) if rods_P is None else np.array(rods_P, dtype=np.float64)
    weight = system.payload.mass * system.gravity
    rounding_N = _BALANCE_TOLERANCE * max(weight, 1.0)
    tensions = _balancing_tensions(system, e, dict(thrusts or {}), rounding_N)

    x = np.zeros(system.n)
    u = np.zeros(system.m)
    for i, uav in enumerate(system.uavs):
        # The thrust, along -b3, carries the UAV's weight and pulls the rod: -f b3 = -(m g k + T e).
        force_I = -(uav.mass * system.gravity * down + tensions[i] * e[i])
        thrust = float(np.linalg.norm(force_I))
        if thrust <= rounding_N:
            thrust = 0.0
        if thrust > 0.0 and force_I[2] >= 0.0:
            problem = f"UAV{i + 1} would have to push down or sideways ({force_I[2]:.3g} N)"
            raise ParameterError(f"no hover equilibrium: {problem}")

        block = x[state.uav_slice(i)]
        block[state.E] = e[i]
        if thrust > 0.0:
            block[state.THETA] = _attitude(force_I, thrust)
        u[state.input_slice(i)][0] = thrust
    frozen(x, u, tensions)
    return Hover(x=x, u=u, tensions=tensions)


def _balancing_tensions(
    system: System, e: Array, thrusts: Mapping[int, float], rounding_N: float
) -> Array:
    """Return the rod tensions that hold the payload level, (N,), N: sum [e, rho x e] t = [m0 g, 0].

    Raises: ParameterError: none do, up to rounding, N and N m.
    """
    rho = np.array([uav.rho for uav in system.uavs])
    wrenches = np.concatenate([e, np.cross(rho, e)], axis=1).T
    load = np.zeros(6)
    load[2] = system.payload.mass * system.gravity

    tensions = np.zeros(system.N)
    given = sorted(thrusts)
    free = np.delete(np.arange(system.N), given)
    # T = (f - m g) (e . k) on a vertical rod; (51) for f = 0.
    for i in given:
        if e[i, 0] != 0.0 or e[i, 1] != 0.0:
            problem = f"expected a vertical rod, got {e[i].tolist()}"
            raise ParameterError(f"no hover with a given thrust of UAV{i + 1}: {problem}")
        own_weight = system.uavs[i].mass * system.gravity
        tensions[i] = (thrusts[i] - own_weight) * e[i, 2]
    # The others have the least norm: (18).
    carried = load - wrenches[:, given] @ tensions[given]
    tensions[free] = np.linalg.lstsq(wrenches[:, free], carried, rcond=None)[0]

    unbalanced = np.abs(wrenches @ tensions - load).max()
    if unbalanced > rounding_N:
        raise ParameterError(
            f"no hover equilibrium: rods at {rho.tolist()} m with directions {e.tolist()} leave "
            f"{unbalanced:.3g} N or N m on the payload; its centre of mass must hang between the "
            "attachment points"
        )
    return tensions


def _attitude(force_I: Array, thrust: float) -> Array:
    """Return the Euler angles of a UAV whose thrust is a force, inertial frame, (3,).

    Zero yaw keeps b1 in the inertial x-z plane, so it is orthogonal to the inertial y axis.
    """
    b3 = -force_I / thrust
    b1 = np.cross([0.0, 1.0, 0.0], b3)
    b1 /= np.linalg.norm(b1)
    return euler_angles(np.column_stack([b1, np.cross(b3, b1), b3]))


def with_released(system: System, released: Collection[int]) -> System:
    """Return the system with bobs in place of released UAVs.

    They have no drag, and keep the inertia, which has no effect.
    """
    uavs = [
        replace(uav, mass=RELEASED_MASS_KG, drag=np.zeros(2)) if i in released else uav
        for i, uav in enumerate(system.uavs)
    ]
    return replace(system, uavs=tuple(uavs))


def hover_after_failures(
    system: System,
    off: Collection[int],
    released: Collection[int],
    thrusts: Mapping[int, float] | None = None,
) -> Hover:
    """Return the hover with UAVs off, 0-based, and given thrusts of others, N.

    `released` are some of those off: a bob hangs in place of each, (50). The rest stand upright on
    their rods, and load the payload with their weight, (51).
    Raises: ParameterError: there is no such hover.
    """
    rods = np.tile([0.0, 0.0, 1.0], (system.N, 1))
    rods[sorted(released)] *= -1.0  # from the bob up to the payload: e = -k
    given = {**(thrusts or {}), **dict.fromkeys(off, 0.0)}
    return hover(with_released(system, released), rods, given)


def motor_off_state(x: Array, uav: int) -> Array:
    """Return the state with the rotation of a UAV stopped, (n,).

    Undamped it would reach the singularity of (3).
    """
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
