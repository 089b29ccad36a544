"""Symbols of a team in CasADi: state, inputs, parameters by body, and external forces."""

from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca


class PayloadSymbols(NamedTuple):
    """Parameters of the payload."""

    mass: ca.SX  # m_0, kg
    inertia: ca.SX  # J_0, (3, 3), payload frame, kg m^2


class UavSymbols(NamedTuple):
    """Parameters of a UAV and its rod."""

    mass: ca.SX  # m_i, kg
    inertia: ca.SX  # J_i, (3, 3), body frame, kg m^2
    rho: ca.SX  # attachment point, (3,), payload frame, m
    length: ca.SX  # l_i of the rod, m


class DragSymbols(NamedTuple):
    """Drag coefficients of a UAV, kg/s."""

    across: ca.SX  # d_i, in the plane of its rotors
    along: ca.SX  # d_i^z, along their axis


@dataclass(frozen=True, slots=True, eq=False)
class Symbols:
    """The symbols of a system of N UAVs.

    State x, input u, parameters p and external forces F (payload, UAVs), N.

    p holds g, m0, the upper triangle of J0, and for each UAV m_i, the upper triangle of J_i, rho_i,
    l_i (`System.vector`), then the gains of inner loops on body rates, then d0 and d_i, d_i^z of each
    UAV.
    """

    N: int
    x: ca.SX
    u: ca.SX
    p: ca.SX
    F: ca.SX
    rates: bool
    drag: bool

    @staticmethod
    def of(N: int, rates: bool = False, drag: bool = False) -> "Symbols":
        """Return new symbols for N UAVs, with or without drag.

        Their inputs are thrust and moments, or thrust and commanded body rates.
        """
        return Symbols(
            N=N,
            x=ca.SX.sym("x", 12 + 12 * N),
            u=ca.SX.sym("u", 4 * N),
            p=ca.SX.sym("p", 8 + 11 * N + 3 * rates + (1 + 2 * N) * drag),
            F=ca.SX.sym("F", 3 + 3 * N),
            rates=rates,
            drag=drag,
        )

    @property
    def gravity(self) -> ca.SX:
        """g, m/s^2."""
        return self.p[0]

    def payload(self) -> PayloadSymbols:
        """Return the parameters of the payload."""
        return PayloadSymbols(mass=self.p[1], inertia=_symmetric(self.p[2:8]))

    def uav(self, i: int) -> UavSymbols:
        """Return the parameters of UAV i (0-based)."""
        q = self.p[8 + 11 * i : 8 + 11 * (i + 1)]
        return UavSymbols(mass=q[0], inertia=_symmetric(q[1:7]), rho=q[7:10], length=q[10])

    @property
    def payload_drag(self) -> ca.SX:
        """Drag coefficient d0 of the payload, kg/s; zero without drag."""
        return self.p[-1 - 2 * self.N] if self.drag else ca.SX(0)

    def uav_drag(self, i: int) -> DragSymbols:
        """Return the drag coefficients of UAV i (0-based)."""
        first = self.p.numel() - 2 * (self.N - i)
        return DragSymbols(across=self.p[first], along=self.p[first + 1])

    @property
    def rate_gains(self) -> ca.SX:
        """K of the inner loops on body rates, (3,), 1/s; only where `rates`."""
        first = 8 + 11 * self.N
        return self.p[first : first + 3]

    def force(self, body: int) -> ca.SX:
        """External force on the payload (0) or on UAV 1..N, (3,), inertial frame, N."""
        return self.F[3 * body : 3 * (body + 1)]


def _symmetric(upper: ca.SX) -> ca.SX:
    """Return a symmetric matrix, (3, 3), by its upper triangle, (6,)."""
    xx, xy, xz, yy, yz, zz = ca.vertsplit(upper)
    return ca.vertcat(ca.horzcat(xx, xy, xz), ca.horzcat(xy, yy, yz), ca.horzcat(xz, yz, zz))
