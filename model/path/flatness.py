"""The motion of a team whose level payload follows a path, by differential flatness.

Sources: Sreenath, Kumar 2013; Mellinger, Kumar 2011; docs/equations.md (66)-(68).
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from transport.model import state
from transport.model.arrays import Array, frozen
from transport.model.path import taylor_jets as jets
from transport.model.physics.hover import Hover
from transport.model.physics.parameters import System

# Of a rod on a reference, as a share of that at hover: gusts would slacken a cable with less.
LEAST_TENSION = 0.1
MOST_TILT = 1.2  # of a UAV on a reference, rad: Euler angles become singular at a right angle


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """Motion of the team along a path at k instants."""

    x: Array  # states, (k, n)
    u: Array  # inputs, (k, m)
    tensions: Array  # of the rods, (k, N), N


def flight(
    system: System, hover: Hover, path: Array, forces: Any = None, released: Collection[int] = ()
) -> Flight:
    """Return the motion of a team whose level payload follows a path: equations.md (66)-(68).

    Args:
        system: The bodies.
        hover: Their hover, whose tensions the team keeps on top of what the path needs.
        path: Jets of the payload's position, inertial, m, (7, k, 3): derivatives of order 0 to 6 by
            time. With length and width of the team relative to hover behind them, (7, k, 5).
        forces: External forces, N, further mass of the payload, kg, and further drag, kg/s, as
            `linearisation.Model` takes them, (4 + 3 N,) or (6 + 3 N,); or of each instant, (k, ..); also
            complex, for derivatives.
        released: UAVs off their rods, 0-based, which are bobs without inputs.
    """
    further = _Further.of(system, forces)
    gone = sorted(released)

    # Rod directions by the forces t of the rods on the payload:  e = -t / |t|.
    t = _rod_forces(system, hover, path, further, released)
    per_tension = jets.power(jets.dot(t, t), -0.5)
    e = -jets.product(t, per_tension)

    # Axes of the UAVs by the forces that push them:  b = pushed / |pushed|.
    r = _places(system, path[..., :3], e)
    pushed = _pushes(system, r, t, further)
    pushed[:, :, gone] = 0.0
    pushed[0, :, gone, 2] = 1.0  # upright, for the directions below
    per_push = jets.power(jets.dot(pushed, pushed), -0.5)
    b = jets.product(pushed, per_push)
    omega = _body_rates(b)

    # Thrust f = |pushed| - (d^z - d) b . r', and moments or commanded rates.
    X = _states(system, path, e, b[0], omega[0])
    inputs = np.concatenate(
        [
            1.0 / per_push[0] - _drag_along(system, b[0], r[1]),
            _commands(system, omega[0], jets.derivative(omega)[0]),
        ],
        axis=-1,
    )
    inputs[:, gone] = 0.0
    U = inputs.reshape(len(X), -1)
    tensions = 1.0 / per_tension[0, ..., 0]
    frozen(X, U, tensions)
    return Flight(x=X, u=U, tensions=tensions)


def _states(system: System, path: Array, e: Array, b: Array, omega: Array) -> Array:
    """Return the states, (k, n), by the jets of path and rods, body axes and body rates, (k, N, 3).

    Omega = e x e', and roll and pitch with zero yaw: (66), (68).
    """
    X = np.zeros((path.shape[1], system.n), dtype=b.dtype)
    X[:, state.R0] = path[0, :, :3]
    X[:, state.V0] = path[1, :, :3]

    blocks = state.StateView(X).uavs
    blocks[..., state.E] = e[0]
    blocks[..., state.ROD_RATE] = np.cross(e[0], e[1])
    blocks[..., state.THETA.start] = -np.arcsin(b[..., 1])
    blocks[..., state.THETA.start + 1] = np.arctan(b[..., 0] / b[..., 2])
    blocks[..., state.OMEGA] = omega
    X[:, state.PAYLOAD :] = blocks.reshape(len(X), -1)
    return X


@dataclass(frozen=True, slots=True, kw_only=True)
class _Further:
    """External forces, and mass and drag beyond the known ones, at one or (k,) instants."""

    on_payload: Array  # (..., 3), N
    on_uavs: Array  # (..., N, 3), N
    mass: Array  # of the payload, (..., 1), kg
    payload_drag: Array  # (..., 1), kg/s
    uav_drag: Array  # of each UAV, in all directions, (..., 1, 1), kg/s

    @staticmethod
    def of(system: System, forces: Any) -> "_Further":
        """Return the parts of forces as `flight` takes them; all zero without any."""
        N = system.N
        F = np.zeros(4 + 3 * N) if forces is None else np.asarray(forces)
        on_uavs = F[..., 3 : 3 + 3 * N]
        mass = F[..., 3 + 3 * N : 4 + 3 * N]
        drag = F[..., 4 + 3 * N :]
        if not drag.shape[-1]:
            drag = np.zeros(2)
        return _Further(
            on_payload=F[..., :3],
            on_uavs=on_uavs.reshape(*on_uavs.shape[:-1], N, 3),
            mass=mass,
            payload_drag=drag[..., :1],
            uav_drag=drag[..., 1:, None],
        )


def _rod_forces(
    system: System, hover: Hover, path: Array, further: _Further, released: Collection[int]
) -> Array:
    """Return the jets of the rods' forces on the payload, (5, k, N, 3), N.

    t = t_hover + W^+ [m0 r0'' + d0 r0' - F_0, 0], and those that hold a formation.
    Source: docs/equations.md (66), (66a).
    """
    rho = np.array([uav.rho for uav in system.uavs])
    gravity = np.array([0.0, 0.0, system.gravity])
    place = path[..., :3]
    formation = path[..., 3:]

    # Force and moment on the payload per force of each rod, (6, 3 N), none of released UAVs.
    columns = []
    for i, r in enumerate(rho):
        moment = np.cross(r, np.eye(3), axisb=0, axisc=0)
        columns.append(np.vstack([np.eye(3), moment]) * (i not in released))
    W = np.hstack(columns)
    share = np.linalg.pinv(W)[:, :3].reshape(system.N, 3, 3)

    # m r0'' - F_0 - (m - m_0) g k + d0 r0': a further mass also weighs.
    mass = system.payload.mass + further.mass
    velocity = jets.derivative(place)
    needed = mass * jets.derivative(velocity)
    needed[0] -= further.on_payload + further.mass * gravity
    if system.has_drag:
        needed += (system.payload.drag + further.payload_drag) * velocity[: len(needed)]

    t = np.einsum("nij,okj->okni", share, needed)
    t[0] -= hover.tensions[:, None] * state.StateView(hover.x).e_P
    if formation.size:
        t += _apart(hover, rho, _column(system, "rod_length"), formation, W)[: len(t)]
    return np.asarray(t)


def _places(system: System, place: Array, e: Array) -> Array:
    """Return the jets of the UAVs' positions, (5, k, N, 3), m: r_i = r0 + rho - l e."""
    r = place[: len(e), :, None] - _column(system, "rod_length") * e
    r[0] += np.array([uav.rho for uav in system.uavs])
    return np.asarray(r)


def _pushes(system: System, r: Array, t: Array, further: _Further) -> Array:
    """Return the jets of the forces along the UAVs' axes b, (3, k, N, 3), N.

    (f + (d^z - d) b . r_i') b = m (g k - r_i'') - t + F_i - d r_i'. Source: docs/equations.md (67).
    """
    masses = _column(system, "mass")
    gravity = np.array([0.0, 0.0, system.gravity])

    velocity = jets.derivative(r)
    pushed = -masses * jets.derivative(velocity) - t[:3]
    pushed[0] += masses * gravity + further.on_uavs
    if system.has_drag:
        across = np.array([uav.drag[:1] for uav in system.uavs])
        pushed = pushed - (across + further.uav_drag) * velocity[: len(pushed)]
    return np.asarray(pushed)


def _drag_along(system: System, b: Array, velocity: Array) -> Array:
    """Return the drag along the axes of UAVs beyond that of `_pushes`, (k, N, 1), N: (d^z - d) b . r'."""
    drag = np.array([uav.drag for uav in system.uavs])
    further = drag[:, 1:] - drag[:, :1]
    return np.asarray(further * np.sum(b * velocity, axis=-1, keepdims=True))


def _body_rates(b: Array) -> Array:
    """Return the jets of the body rates of UAVs with zero yaw, (2, k, N, 3), 1/s, by their axes b.

    omega = [phi', theta' cos phi, -theta' sin phi], sin phi = -b_y, tan theta = b_x / b_z.
    Source: docs/equations.md (68).
    """
    # phi' = -b_y' / cos phi,  cos phi = sqrt(b_x^2 + b_z^2)
    x = b[..., 0]
    y = b[..., 1]
    z = b[..., 2]
    cos_roll = jets.power(jets.product(x, x) + jets.product(z, z), 0.5)
    roll_rate = -jets.product(jets.derivative(y), jets.power(cos_roll, -1.0))

    # theta' = (b_x' b_z - b_x b_z') / cos^2 phi
    turned = jets.product(jets.derivative(x), z) - jets.product(x, jets.derivative(z))
    pitch_rate = jets.product(turned, jets.power(cos_roll, -2.0))
    across = jets.product(pitch_rate, cos_roll)
    down = jets.product(pitch_rate, y)
    return np.stack([roll_rate, across, down], axis=-1)


def _commands(system: System, omega: Array, omega_dot: Array) -> Array:
    """Return moments or commanded body rates, (k, N, 3), by body rates and their derivatives.

    tau = J omega' + omega x J omega, or omega + omega' / K. Source: docs/equations.md (57), (68).
    """
    if system.rate_gains is not None:
        return np.asarray(omega + omega_dot / system.rate_gains)

    J = np.array([uav.inertia for uav in system.uavs])
    momentum = np.einsum("nij,knj->kni", J, omega)
    turning = np.einsum("nij,knj->kni", J, omega_dot)
    return np.asarray(turning + np.cross(omega, momentum))


def _column(system: System, key: str) -> Array:
    """Return a number of each UAV, (N, 1)."""
    return np.array([[getattr(uav, key)] for uav in system.uavs])


def _apart(hover: Hover, rho: Array, lengths: Array, formation: Array, W: Array) -> Array:
    """Return the jets of rod forces that hold a formation, (7, k, N, 3), N.

    They have no effect on the payload: t_i += [(I - W^+ W) h]_i. Source: docs/equations.md (66a).
    """
    # d_i = [(lambda_x - 1) rho_ix, (lambda_y - 1) rho_iy, 0]
    d = np.zeros((*formation.shape[:2], *rho.shape))
    d[0, ..., :2] = -rho[:, :2]
    d[..., :2] += formation[:, :, None] * rho[:, :2]

    # h_i = |t_i^hov| d_i / sqrt(l_i^2 - |d_i|^2), none of released UAVs.
    height_squared = -jets.dot(d, d)
    height_squared[0] += lengths**2
    h = hover.tensions[:, None] * jets.product(d, jets.power(height_squared, -0.5))
    flat = h.reshape(*h.shape[:2], -1) * W.any(axis=0)

    without_effect = flat - flat @ (np.linalg.pinv(W) @ W).T
    return np.asarray(without_effect.reshape(h.shape))


def slowed(path: Array, factor: float) -> Array:
    """Return the jets of a path at a number of its places when it takes `factor` times as long."""
    # The derivative of order j falls with factor^j.
    orders = np.arange(len(path), dtype=np.float64)
    return np.asarray(path / factor ** orders[:, None, None])
