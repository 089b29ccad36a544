"""Energy, linear and angular momentum of the whole system, as sums over the bodies."""

import numpy as np

from model.arrays import Array
from model.parameters import System
from model.state import StateView
from tests.support.paper_form import attitude


def vehicle_motion(system: System, x: Array) -> tuple[Array, Array]:
    """Return UAV positions by paper (1) and velocities by paper (4), each (N, 3), inertial frame, m and m/s."""
    view = StateView(x)
    R0 = attitude(view.Theta0)
    rho = np.array([uav.rho for uav in system.uavs])
    rods = np.array([[uav.rod_length] for uav in system.uavs])
    position = view.r0_I + (rho - rods * view.e_P) @ R0.T
    velocity = (view.v0_P + np.cross(view.omega0_P, rho) - rods * np.cross(view.Omega_P, view.e_P)) @ R0.T
    return position, velocity


def energy(system: System, x: Array) -> float:
    """Return the kinetic energy of all bodies plus potential energy -m g z (z is down), J."""
    view = StateView(x)
    r, v = vehicle_motion(system, x)
    payload = system.payload
    total = payload.mass * (view.v0_P @ view.v0_P / 2.0 - system.gravity * view.r0_I[2])
    total += view.omega0_P @ payload.inertia @ view.omega0_P / 2.0
    for uav, r_i, v_i, omega in zip(system.uavs, r, v, view.omega_B, strict=True):
        total += uav.mass * (v_i @ v_i / 2.0 - system.gravity * r_i[2]) + omega @ uav.inertia @ omega / 2.0
    return float(total)


def linear_momentum(system: System, x: Array) -> Array:
    """Return the linear momentum of all bodies, (3,), inertial frame, kg m/s."""
    view = StateView(x)
    _, v = vehicle_motion(system, x)
    masses = np.array([uav.mass for uav in system.uavs])
    return np.asarray(system.payload.mass * attitude(view.Theta0) @ view.v0_P + masses @ v)


def angular_momentum(system: System, x: Array) -> Array:
    """Return the angular momentum about the inertial origin, without the UAVs' spin, (3,), inertial frame, kg m^2/s."""
    view = StateView(x)
    r, v = vehicle_motion(system, x)
    R0, payload = attitude(view.Theta0), system.payload
    total = R0 @ payload.inertia @ view.omega0_P + payload.mass * np.cross(view.r0_I, R0 @ view.v0_P)
    for uav, r_i, v_i in zip(system.uavs, r, v, strict=True):
        total = total + uav.mass * np.cross(r_i, v_i)
    return np.asarray(total)


def spin(system: System, x: Array) -> Array:
    """Return the angular momentum of each UAV about its own centre of mass, (N, 3), inertial frame, kg m^2/s."""
    view = StateView(x)
    turns = zip(system.uavs, view.Theta, view.omega_B, strict=True)
    return np.array([attitude(Theta) @ uav.inertia @ omega for uav, Theta, omega in turns])
