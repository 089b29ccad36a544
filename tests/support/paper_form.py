"""The accelerations in the paper's form.

One linear system in (v0', omega0', Omega_1', ..., Omega_N').

An oracle that shares only the order of the state with `model/`: it uses numpy instead of CasADi,
the full mass matrix instead of rod tensions, and SciPy's rotations instead of the project's.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.parameters import System
from transport.model.state import StateView

K = np.array([0.0, 0.0, 1.0])  # direction of gravity, inertial frame


def attitude(Theta: Array) -> Array:
    """Return the rotation matrix of roll, pitch, yaw by SciPy, (3, 3)."""
    return np.asarray(Rotation.from_euler("ZYX", Theta[::-1]).as_matrix())


def cross(a: Array) -> Array:
    """Return the matrix of a x (.), (3, 3)."""
    return np.cross(a, np.eye(3)).T


def thrust_forces(x: Array, u: Array) -> Array:
    """Return f_i of the paper, (N, 3), inertial frame, N.

    Along -b3 of each UAV, because our thrust is lift.
    """
    attitudes = StateView(x).Theta
    return np.array(
        [-u[state.INPUTS * i] * (attitude(Theta) @ K) for i, Theta in enumerate(attitudes)]
    )


def mass_matrix(system: System, x: Array) -> Array:
    """Return M_0q of paper (11), (6 + 3 N, 6 + 3 N)."""
    N, rods = system.N, StateView(x).e_P
    M = np.zeros((6 + 3 * N, 6 + 3 * N))
    M[:3, :3] = system.total_mass * np.eye(3)
    M[3:6, 3:6] = effective_inertia(system)
    for i, (uav, e) in enumerate(zip(system.uavs, rods, strict=True)):
        rod = slice(6 + 3 * i, 9 + 3 * i)
        m, length, rho_x, e_x = uav.mass, uav.rod_length, cross(uav.rho), cross(e)
        M[:3, 3:6] -= m * rho_x
        M[3:6, :3] += m * rho_x
        M[:3, rod] = m * length * e_x
        M[3:6, rod] = m * length * rho_x @ e_x
        M[rod, :3] = -m * length * e_x
        M[rod, 3:6] = m * length * e_x @ rho_x
        M[rod, rod] = m * length**2 * np.eye(3)
    return M


def effective_inertia(system: System) -> Array:
    """Return the barred J_0 below paper (10).

    The payload with each UAV's mass at its attachment point, (3, 3).
    """
    return system.payload.inertia - sum(
        uav.mass * cross(uav.rho) @ cross(uav.rho) for uav in system.uavs
    )


def right_hand_side(system: System, x: Array, force_I: Array) -> Array:
    """Return f_0q of paper (11), (6 + 3 N,).

    Paper (7) as published has m_i l_i |Omega_i|^2 e_i behind the sum. Its free index i requires it
    inside the sum, as in (11).
    """
    view = StateView(x)
    v0, omega0 = view.v0_P, view.omega0_P
    R0 = attitude(view.Theta0)
    J_bar, w, g = effective_inertia(system), cross(omega0), system.gravity
    translation: Any = system.total_mass * (g * R0.T @ K - w @ v0)
    rotation: Any = -w @ J_bar @ omega0
    links = []
    for uav, e, Omega, f in zip(system.uavs, view.e_P, view.Omega_P, force_I, strict=True):
        m, length, rho, rho_x, e_x = uav.mass, uav.rod_length, uav.rho, cross(uav.rho), cross(e)
        swing = length * (Omega @ Omega) * e + length * e_x @ w @ Omega
        external = R0.T @ (f + m * g * K)
        translation += R0.T @ f - m * (w @ w @ rho + swing)
        rotation += rho_x @ external - m * rho_x @ (w @ v0 + swing)
        links.append(
            m * length * (e_x @ w @ w @ rho - length * w @ Omega + e_x @ w @ v0)
            - length * e_x @ external
        )
    return np.concatenate([translation, rotation, *links])


def accelerations(system: System, x: Array, force_I: Array) -> tuple[Array, Array, Array]:
    """Return v0' (3,), omega0' (3,) and Omega_i' (N, 3), payload frame, by paper (11).

    Args:
        system: Physical parameters.
        x: State, (12 + 12 N,).
        force_I: f_i, (N, 3), inertial frame, N.
    """
    solution = np.asarray(
        np.linalg.solve(mass_matrix(system, x), right_hand_side(system, x, force_I)),
        dtype=np.float64,
    )
    return solution[:3], solution[3:6], solution[6:].reshape(-1, 3)
