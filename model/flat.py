"""References that a team can fly, by differential flatness (Sreenath, Kumar 2013.

Mellinger, Kumar 2011).
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from transport.model import jets, state
from transport.model.arrays import Array, Rows, frozen
from transport.model.hover import Hover
from transport.model.identity import digest
from transport.model.maneuver import Maneuver
from transport.model.parameters import System

LEAST_TENSION = 0.1  # of a rod on a reference, as a share of that at hover: gusts would slacken a cable with less
MOST_TILT = 1.2  # of a UAV on a reference, rad: Euler angles become singular at a right angle
_BLOCK = 16  # rows of a reference whose derivatives with respect to forces are computed at once
_STEP_N = 1e-30  # imaginary step of these derivatives, N: without differences, so without rounding


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """Motion of the team along a path at k instants."""

    x: Array  # states, (k, n)
    u: Array  # inputs, (k, m)
    tensions: Array  # of the rods, (k, N), N


@dataclass(frozen=True, kw_only=True)
class Track:
    """What controllers follow at instants 0..K-1 from `first` on, one sampling period apart.

    The last one is held.
    """

    X: Array  # states, (K, n)
    U: Array  # inputs for the period after each instant: those of its middle, (K, m)
    X_middle: Array  # states there, (K, n)
    paths: Array  # jets of the payload's path at the instants and in the middle after each, (K, 2, 7, 3)
    first: int = 0  # number of the first instant
    flown: Callable[
        [Array, Any], Flight
    ]  # the motion of the team along such a path under forces, as `flight`

    @property
    def key(self) -> bytes:
        """Digest of the numbers that controllers follow."""
        return digest(self.X, self.U, self.X_middle, self.paths, self.first)

    def by_forces(self, at: Rows) -> tuple[Array, Array]:
        """Return the change of X, (k, n, 4 + 3 N), and U, (k, m, 4 + 3 N), at k rows per external force and mass."""
        places = [divmod(row, _BLOCK) for row in np.arange(len(self.X))[at].tolist()]
        X_forces, U_forces = (
            [self._block(number)[part][row] for number, row in places] for part in (0, 1)
        )
        return np.array(X_forces), np.array(U_forces)

    def _block(self, number: int) -> list[Array]:
        """Return the change of rows `number * _BLOCK` on by each force."""
        if number not in self._blocks:
            paths = self.paths[number * _BLOCK : (number + 1) * _BLOCK]
            forces = 4 + 3 * (self.U.shape[1] // state.INPUTS)
            path, middle = np.repeat(np.ascontiguousarray(np.moveaxis(paths, 0, 2)), forces, axis=2)
            steps = np.tile(1j * _STEP_N * np.eye(forces), (len(paths), 1))
            changed = self.flown(path, steps).x, self.flown(middle, steps).u
            by_row = [part.imag.reshape(len(paths), forces, -1) / _STEP_N for part in changed]
            self._blocks[number] = [part.transpose(0, 2, 1) for part in by_row]
        return self._blocks[number]

    @cached_property
    def _blocks(self) -> dict[int, list[Array]]:
        return {}


class FlatReference:
    """Reference outputs, states and inputs of a maneuver with a smooth path."""

    def __init__(self, system: System, hover: Hover, maneuver: Maneuver) -> None:
        self.maneuver = maneuver
        self._system, self._hover = system, hover

    @property
    def key(self) -> bytes:
        """Digest of the numbers that the reference follows from."""
        return digest("flat", self._system, self._hover, self.maneuver)

    def with_maneuver(self, maneuver: Maneuver) -> "FlatReference":
        """Return the reference of another maneuver of the team."""
        return FlatReference(self._system, self._hover, maneuver)

    def outputs(self, t_s: Array) -> Array:
        """Return y_ref at times t_s, (k,), s: (k, 4 N + 9), SI: equations.md (14), (66)-(68)."""
        return self.followed(t_s)[0]

    def states(self, t_s: Array) -> Array:
        """Return x_ref at times t_s, (k,), s: (k, 12 + 12 N), SI: equations.md (66)-(68)."""
        return flight(self._system, self._hover, self.maneuver.jets(t_s)).x

    def followed(self, t_s: Array) -> tuple[Array, Array]:
        """Return outputs and states, which controllers follow, at times t_s, (k, 4 N + 9) and (k, 12 + 12 N)."""
        path = self.maneuver.jets(t_s)
        x = flight(self._system, self._hover, path).x
        view = state.StateView(x)
        rho = np.array([uav.rho for uav in self._system.uavs])
        lengths = np.array([uav.rod_length for uav in self._system.uavs])
        places = view.r0_I[:, None] + rho - lengths[:, None] * view.e_P
        parts = [
            places.reshape(len(x), -1),
            view.Theta0,
            view.omega_B[:, :, 2],
            path[0, :, :3],
            path[1, :, :3],
        ]
        return np.hstack(parts), x

    def track(self, instants: int, period_s: float, first: int = 0) -> Track:
        """Return what controllers follow over a number of instants from the first on, one period apart, s."""
        times = period_s * np.arange(first, first + instants, dtype=np.float64)
        paths = np.stack([self.maneuver.jets(times), self.maneuver.jets(times + period_s / 2.0)])
        return track(
            self._system, self._hover, np.ascontiguousarray(np.moveaxis(paths, 2, 0)), first
        )


def track(
    system: System, hover: Hover, by_instant: Array, first: int = 0, released: Collection[int] = ()
) -> Track:
    """Return what controllers follow along a path, given as in `Track`; the rest as in `flight`."""
    flown = partial(flight, system, hover, released=released)
    at, between = (
        flown(jets_of) for jets_of in np.ascontiguousarray(np.moveaxis(by_instant, 0, 2))
    )
    frozen(by_instant)
    return Track(
        X=at.x, U=between.u, X_middle=between.x, paths=by_instant, first=first, flown=flown
    )


def flight(
    system: System, hover: Hover, path: Array, forces: Any = None, released: Collection[int] = ()
) -> Flight:
    """Return the motion of a team whose level payload follows a path: equations.md (66)-(68).

    Given are jets of position, m, and of length and width of the team, relative to hover, (7, k,
    5), or (7, k, 3), forces and further mass of the payload, (4 + 3 N,) or of each instant, also
    complex, and released UAVs, now bobs.
    """
    N = system.N
    F = np.zeros(4 + 3 * N) if forces is None else forces
    gone = sorted(released)

    t = _rod_forces(system, hover, path, F, released)
    per_tension = jets.power(jets.dot(t, t), -0.5)
    e = -jets.product(t, per_tension)

    pushed = _pushes(system, path[..., :3], e, t, F)
    pushed[:, :, gone] = 0.0
    pushed[0, :, gone, 2] = 1.0  # upright, for the directions below
    per_thrust = jets.power(jets.dot(pushed, pushed), -0.5)
    b3 = jets.product(pushed, per_thrust)
    omega = _body_rates(b3)

    X = np.zeros((path.shape[1], system.n), dtype=pushed.dtype)
    X[:, state.R0] = path[0, :, :3]
    X[:, state.V0] = path[1, :, :3]
    blocks = state.StateView(X).uavs
    blocks[..., state.E] = e[0]
    blocks[..., state.ROD_RATE] = np.cross(e[0], e[1])
    # Roll and pitch with zero yaw.
    blocks[..., state.THETA.start] = -np.arcsin(b3[0, ..., 1])
    blocks[..., state.THETA.start + 1] = np.arctan(b3[0, ..., 0] / b3[0, ..., 2])
    blocks[..., state.OMEGA] = omega[0]
    X[:, state.PAYLOAD :] = blocks.reshape(len(X), -1)

    commands = _commands(system, omega[0], jets.derivative(omega)[0])
    inputs = np.concatenate([1.0 / per_thrust[0], commands], axis=-1)
    inputs[:, gone] = 0.0
    U = inputs.reshape(len(X), -1)
    tensions = 1.0 / per_tension[0, ..., 0]
    frozen(X, U, tensions)
    return Flight(x=X, u=U, tensions=tensions)


def _rod_forces(
    system: System, hover: Hover, path: Array, F: Any, released: Collection[int]
) -> Array:
    """Return the jets of the rods' forces on the payload, (5, k, N, 3), N.

    t = t_hover + W^+ [m0 r0'' - F_0, 0], and those that hold a formation.
    Source: docs/equations.md (66), (66a).
    """
    rho = np.array([uav.rho for uav in system.uavs])
    gravity = np.array([0.0, 0.0, system.gravity])
    place, formation = path[..., :3], path[..., 3:]

    # Force and moment on the payload per force of each rod, (6, 3 N), none of released UAVs.
    columns = []
    for i, r in enumerate(rho):
        moment = np.cross(r, np.eye(3), axisb=0, axisc=0)
        columns.append(np.vstack([np.eye(3), moment]) * (i not in released))
    W = np.hstack(columns)
    share = np.linalg.pinv(W)[:, :3].reshape(system.N, 3, 3)

    mass = system.payload.mass + F[..., -1:]
    needed = mass * jets.derivative(jets.derivative(place))
    needed[0] -= F[..., :3] + F[..., -1:] * gravity
    t = np.einsum("nij,okj->okni", share, needed)
    t[0] -= hover.tensions[:, None] * state.StateView(hover.x).e_P
    if formation.size:
        t += _apart(hover, rho, _column(system, "rod_length"), formation, W)[: len(t)]
    return np.asarray(t)


def _pushes(system: System, place: Array, e: Array, t: Array, F: Any) -> Array:
    """Return the jets of thrust times direction of the UAVs, (3, k, N, 3), N.

    f b3 = m (g - r_i'') - t + F_i at r_i = r0 + rho - l e. Source: docs/equations.md (67).
    """
    rho = np.array([uav.rho for uav in system.uavs])
    masses = _column(system, "mass")
    gravity = np.array([0.0, 0.0, system.gravity])

    r = place[: len(e), :, None] - _column(system, "rod_length") * e
    r[0] += rho
    pushed = -masses * jets.derivative(jets.derivative(r)) - t[:3]
    pushed[0] += masses * gravity + F[..., 3:-1].reshape(-1, system.N, 3)
    return np.asarray(pushed)


def _body_rates(b3: Array) -> Array:
    """Return the jets of the body rates of UAVs with zero yaw, (2, k, N, 3), 1/s, by their axes b3.

    omega = [phi', theta' cos phi, -theta' sin phi], sin phi = -b3_y, tan theta = b3_x / b3_z.
    Source: docs/equations.md (68).
    """
    x, y, z = b3[..., 0], b3[..., 1], b3[..., 2]
    cos_roll = jets.power(jets.product(x, x) + jets.product(z, z), 0.5)
    roll_rate = -jets.product(jets.derivative(y), jets.power(cos_roll, -1.0))

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
    """Return the jets of rod forces that hold a formation without effect on the payload, (7, k, N, 3), N: (66a)."""
    away = np.zeros((*formation.shape[:2], *rho.shape))
    away[0, ..., :2] = -rho[:, :2]
    away[..., :2] += formation[:, :, None] * rho[:, :2]
    below = -jets.dot(away, away)
    below[0] += lengths**2
    pulls = hover.tensions[:, None] * jets.product(away, jets.power(below, -0.5))
    flat = pulls.reshape(*pulls.shape[:2], -1) * W.any(axis=0)  # none of released UAVs
    return np.asarray((flat - flat @ (np.linalg.pinv(W) @ W).T).reshape(pulls.shape))


def slowed(path: Array, factor: float) -> Array:
    """Return the jets of a path at a number of its places when it takes `factor` times as long."""
    return np.asarray(path / factor ** np.arange(len(path), dtype=np.float64)[:, None, None])
