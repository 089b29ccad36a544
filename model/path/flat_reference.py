"""References that a team can fly: states and inputs along a smooth path."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from transport.model import state
from transport.model.arrays import Array, Rows, frozen
from transport.model.digests_and_shared_results import digest
from transport.model.path.flatness import Flight, flight
from transport.model.path.maneuver import Maneuver
from transport.model.physics.hover import Hover
from transport.model.physics.parameters import System

_BLOCK = 16  # rows of a reference whose derivatives with respect to forces are computed at once
_STEP_N = 1e-30  # imaginary step of these derivatives, N: without differences, so without rounding


@dataclass(frozen=True, kw_only=True)
class Track:
    """The reference of controllers at instants 0..K-1 from `first` on, one sampling period apart.

    The last one is held.
    """

    X: Array  # states, (K, n)
    U: Array  # inputs for the period after each instant: those of its middle, (K, m)
    X_middle: Array  # states there, (K, n)
    # Jets of the payload's path at the instants and in the middle after each, (K, 2, 7, 3); with a
    # formation (K, 2, 7, 5).
    paths: Array
    first: int = 0  # number of the first instant
    external: int  # number of external forces, with further mass and drag as `flight` takes them
    # The motion of the team along such a path under forces, as `flight`.
    flown: Callable[[Array, Any], Flight]

    @property
    def key(self) -> bytes:
        """Digest of the numbers that controllers follow."""
        return digest(self.X, self.U, self.X_middle, self.paths, self.first)

    def by_forces(self, rows: Rows) -> tuple[Array, Array]:
        """Return the derivatives of X and U at k rows by each external force, mass and drag.

        (k, n, `external`), and (k, m, `external`), SI.
        """
        X_forces = []
        U_forces = []
        for row in np.arange(len(self.X))[rows].tolist():
            number, place = divmod(row, _BLOCK)
            block = self._blocks.get(number)
            if block is None:
                block = self._block(number)
                self._blocks[number] = block
            X_forces.append(block.X[place])
            U_forces.append(block.U[place])
        return np.array(X_forces), np.array(U_forces)

    def _block(self, number: int) -> "_ByForces":
        """Return the change of rows from `number * _BLOCK` on by each force.

        By complex steps: dx/dF = Im x(F + i h) / h, each force at each row.
        """
        paths = self.paths[number * _BLOCK : (number + 1) * _BLOCK]
        rows = len(paths)
        forces = self.external
        by_order = np.ascontiguousarray(np.moveaxis(paths, 0, 2))
        path, middle = np.repeat(by_order, forces, axis=2)  # (orders, rows forces, 3) each
        steps = np.tile(1j * _STEP_N * np.eye(forces), (rows, 1))

        x = self.flown(path, steps).x
        u = self.flown(middle, steps).u
        X = x.imag.reshape(rows, forces, -1) / _STEP_N
        U = u.imag.reshape(rows, forces, -1) / _STEP_N
        return _ByForces(X=X.transpose(0, 2, 1), U=U.transpose(0, 2, 1))

    @cached_property
    def _blocks(self) -> dict[int, "_ByForces"]:
        """Derivatives by block of rows: they cost more than the reference, and few are needed.

        No field, so that `replace` and `continued`, which move rows, begin with none.
        """
        return {}


@dataclass(frozen=True, slots=True, kw_only=True)
class _ByForces:
    """Change of a block of rows of a track per external force, mass and drag, SI."""

    X: Array  # (rows, n, external)
    U: Array  # (rows, m, external)


class FlatReference:
    """Reference outputs, states and inputs of a maneuver with a smooth path."""

    def __init__(self, system: System, hover: Hover, maneuver: Maneuver) -> None:
        self.maneuver = maneuver
        self._system = system
        self._hover = hover

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
        """Return the outputs and states that controllers follow, at times t_s, (k,), s.

        (k, 4 N + 9) and (k, 12 + 12 N), SI.
        """
        path = self.maneuver.jets(t_s)
        x = flight(self._system, self._hover, path).x
        view = state.StateView(x)

        # r_i = r0 + rho_i - l_i e_i: (14), with a level payload.
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
        """Return the track of a number of instants from the first on, one period apart, s."""
        times_s = period_s * np.arange(first, first + instants, dtype=np.float64)
        middles_s = times_s + period_s / 2.0
        paths = np.stack([self.maneuver.jets(times_s), self.maneuver.jets(middles_s)])

        by_instant = np.ascontiguousarray(np.moveaxis(paths, 2, 0))
        return track(self._system, self._hover, by_instant, first)


def track(
    system: System, hover: Hover, by_instant: Array, first: int = 0, released: Collection[int] = ()
) -> Track:
    """Return the track along a path, given as in `Track`; the rest as in `flight`."""
    flown = partial(flight, system, hover, released=released)
    path, middle = np.ascontiguousarray(np.moveaxis(by_instant, 0, 2))
    on_instants = flown(path)
    between = flown(middle)
    frozen(by_instant)
    return Track(
        X=on_instants.x,
        U=between.u,
        X_middle=between.x,
        paths=by_instant,
        first=first,
        external=4 + 3 * system.N + 2 * system.has_drag,
        flown=flown,
    )
