"""The linearisation of the paper's equations (7)-(11), without elimination of unknowns.

An oracle for the model's.

No term assumes |e_i| = 1, as an elimination before the derivative may do.
"""

import casadi as ca
import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.linearisation import Linearisation, Model
from transport.model.physics.parameters import System
from transport.model.physics.rotations import euler_rates, rotation
from transport.model.physics.symbols import Symbols

K = ca.DM([0.0, 0.0, 1.0])  # direction of gravity, inertial frame


class PublishedModel(Model):
    """The model of a system with A_c from the published equations, by implicit differentiation of (11).

    Args:
        system: Physical parameters.
    """

    def __init__(self, system: System) -> None:
        super().__init__(system)
        self._vector, symbols = system.vector(), Symbols.of(system.N)
        x, u, p = symbols.x, symbols.u, symbols.p
        M, b = published(symbols)
        q = ca.SX.sym("q", b.shape[0])  # v0', omega0', Omega_1' .. Omega_N'
        # M q = b: the derivative of q is M^-1 times that of b - M q at constant q.
        slope = ca.jacobian(b - M @ q, x)
        held, (rows, motion) = [x, u, p], kinematics(symbols)
        self._system = ca.Function("system", held, [M, b])
        self._slope = ca.Function(
            "slope", [*held, q], [ca.densify(slope), ca.densify(ca.jacobian(motion, x))]
        )
        self._rows = np.concatenate([np.arange(3, 6), np.arange(9, 12), *_rod_rates(system.N)])
        self._moving = np.array(rows)
        # Agents with the same state need the same A_c.
        self._newest: tuple[bytes, Array] | None = None

    def accelerations(self, x: Array, u: Array) -> Array:
        """Return (v0', omega0', Omega_1', .., Omega_N'), (6 + 3 N,), SI, at any rod lengths."""
        M, b = self._system(x, u, self._vector)
        return np.asarray(np.linalg.solve(np.asarray(M), np.asarray(b)[:, 0]))

    def linearise(self, x: Array, u: Array, *, forces: Array | None = None) -> Linearisation:
        """Linearise as the model does, with A_c = df/dx of the published equations, without external forces."""
        found = super().linearise(x, u, forces=forces)
        at = np.concatenate([x, u]).tobytes()
        if self._newest is None or self._newest[0] != at:
            self._newest = at, self._expanded(x, u)
        return Linearisation.of(found.f, self._newest[1], found.B_c, found.y, found.C)

    def _expanded(self, x: Array, u: Array) -> Array:
        M, b = (np.asarray(matrix) for matrix in self._system(x, u, self._vector))
        slope, motion = self._slope(x, u, self._vector, np.linalg.solve(M, b))
        A_c = np.zeros((len(x), len(x)))
        A_c[self._rows] = np.linalg.solve(M, np.asarray(slope))
        A_c[self._moving] = np.asarray(motion)
        return A_c


def _rod_rates(N: int) -> list[Array]:
    return [np.arange(3) + state.uav_slice(i).start + state.ROD_RATE.start for i in range(N)]


def published(symbols: Symbols) -> tuple[ca.SX, ca.SX]:
    """Return M_0q and f_0q of paper (11), with the term of (7) inside its sum (`tests.support.paper_form`)."""
    x, N = symbols.x, symbols.N
    v0, w = x[state.V0], ca.skew(x[state.OMEGA0])
    R0, g = rotation(x[state.THETA0]), symbols.gravity
    m_T, J_bar = symbols.payload()
    M = ca.SX.zeros(6 + 3 * N, 6 + 3 * N)
    translation, turning = ca.SX.zeros(3), ca.SX.zeros(3)
    links = []
    for i in range(N):
        m, _, rho, length = symbols.uav(i)
        block = x[state.uav_slice(i)]
        e, Omega = block[state.E], block[state.ROD_RATE]
        rho_x, e_x, rod = ca.skew(rho), ca.skew(e), slice(6 + 3 * i, 9 + 3 * i)
        J_bar, m_T = J_bar - m * rho_x @ rho_x, m_T + m
        M[:3, 3:6] -= m * rho_x
        M[3:6, :3] += m * rho_x
        M[:3, rod] = m * length * e_x
        M[3:6, rod] = m * length * rho_x @ e_x
        M[rod, :3] = -m * length * e_x
        M[rod, 3:6] = m * length * e_x @ rho_x
        M[rod, rod] = m * length**2 * ca.SX.eye(3)
        force = -symbols.u[state.INPUTS * i] * rotation(block[state.THETA])[:, 2]
        external = R0.T @ (force + m * g * K)
        swing = length * ca.dot(Omega, Omega) * e + length * e_x @ w @ Omega
        translation += R0.T @ force - m * (w @ w @ rho + swing)
        turning += rho_x @ external - m * rho_x @ (w @ v0 + swing)
        links.append(
            m * length * (e_x @ w @ w @ rho - length * w @ Omega + e_x @ w @ v0)
            - length * e_x @ external
        )
    M[:3, :3] = m_T * ca.SX.eye(3)
    M[3:6, 3:6] = J_bar
    translation += m_T * (g * R0.T @ K - w @ v0)
    turning += -w @ J_bar @ x[state.OMEGA0]
    return M, ca.vertcat(translation, turning, *links)


def kinematics(symbols: Symbols) -> tuple[list[int], ca.SX]:
    """Return the rows of the state without derivative in (11), and their derivative by paper (2), (5), (6), (10)."""
    x = symbols.x
    omega0 = x[state.OMEGA0]
    rows = [*range(3), *range(6, 9)]
    motion = [rotation(x[state.THETA0]) @ x[state.V0], euler_rates(x[state.THETA0]) @ omega0]
    for i in range(symbols.N):
        _, J, _, _ = symbols.uav(i)
        start, block = state.uav_slice(i).start, x[state.uav_slice(i)]
        omega = block[state.OMEGA]
        tau = symbols.u[state.INPUTS * i + 1 : state.INPUTS * (i + 1)]
        rows += [*range(start, start + 3), *range(start + 6, start + 12)]
        motion += [
            ca.cross(block[state.ROD_RATE] - omega0, block[state.E]),
            euler_rates(block[state.THETA]) @ omega,
            ca.inv(J) @ (tau - ca.cross(omega, J @ omega)),
        ]
    return rows, ca.vertcat(*motion)
