"""The equations of motion as CasADi expressions.

A 6 x 6 system in the payload's acceleration (docs/equations.md).
"""

from dataclasses import dataclass

import casadi as ca

from transport.model import state
from transport.model.rotations import euler_rates, rotation


@dataclass(frozen=True, slots=True, eq=False)
class Symbols:
    """The symbols of a system of N UAVs.

    State x, input u, parameters p and external forces F (payload, UAVs), N.

    p holds g, m0, the upper triangle of J0, and for each UAV m_i, the upper triangle of J_i, rho_i,
    l_i
    (`System.vector`), then the gains of inner loops on body rates.
    """

    N: int
    x: ca.SX
    u: ca.SX
    p: ca.SX
    F: ca.SX
    rates: bool

    @staticmethod
    def of(N: int, rates: bool = False) -> "Symbols":
        """Return new symbols for N UAVs whose inputs are thrust and moments, or thrust and commanded body rates."""
        sizes = {"x": 12 + 12 * N, "u": 4 * N, "p": 8 + 11 * N + 3 * rates, "F": 3 + 3 * N}
        return Symbols(
            N, **{name: ca.SX.sym(name, size) for name, size in sizes.items()}, rates=rates
        )

    def payload(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """g (m/s^2), m0 (kg), J0 (3, 3, payload frame, kg m^2)."""
        return self.p[0], self.p[1], _symmetric(self.p[2:8])

    def uav(self, i: int) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """m_i (kg), J_i (3, 3, kg m^2), rho_i (3, m), l_i (m) of UAV i (0-based)."""
        q = self.p[8 + 11 * i : 8 + 11 * (i + 1)]
        return q[0], _symmetric(q[1:7]), q[7:10], q[10]

    def force(self, body: int) -> ca.SX:
        """External force on the payload (0) or on UAV 1..N, (3,), inertial frame, N."""
        return self.F[3 * body : 3 * (body + 1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Right-hand side and rod tensions, SI."""

    derivative: ca.SX  # x' = f(x, u, F), (12 + 12 N,)
    tensions: ca.SX  # (N,), positive when the rod pulls
    # Payload's acceleration and angular acceleration, payload frame, (6,): all that a UAV and its
    # rod notice of the other UAVs; M of the equation M acceleration = b, (6, 6); b - M
    # acceleration, zero unless that is given, (6,).
    acceleration: ca.SX
    mass: ca.SX
    unbalanced: ca.SX


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rod:
    """A UAV and its rod as the payload notices them, payload frame, SI."""

    m: ca.SX  # mass of the UAV
    rho: ca.SX  # attachment point, (3,)
    length: ca.SX
    e: ca.SX  # direction, (3,)
    Omega: ca.SX  # angular velocity, (3,)
    s_P: ca.SX  # specific force of the UAV without rod, (3,)
    centripetal: ca.SX  # omega0 x (omega0 x rho), (3,)
    along: ca.SX  # tension per mass with the payload at rest
    wrench: ca.SX  # force and moment on the payload per tension, (6,)


def motion(symbols: Symbols, given: ca.SX | None = None) -> Motion:
    """Return the right-hand side, also under a given payload acceleration, (6,).

    The payload's acceleration a0 = v0' + omega0 x v0 and omega0' solve a 6 x 6 system, M [a0,
    omega0'] = b, to which every UAV adds m w w' and -m along w, with w = [e, rho x e].
    Source: docs/equations.md (4)-(13), (37), (57).
    """
    x, N = symbols.x, symbols.N
    v0, omega0 = x[state.V0], x[state.OMEGA0]
    R0 = rotation(x[state.THETA0])
    g, m0, J0 = symbols.payload()
    g_P = g * R0[2, :].T  # gravity in the payload frame

    # The payload alone.
    payload_M = ca.diagcat(m0 * ca.SX.eye(3), J0)
    payload_force = m0 * g_P + R0.T @ symbols.force(0)
    payload_b = ca.vertcat(payload_force, -ca.cross(omega0, J0 @ omega0))

    rods = [_rod(symbols, i, R0, g_P) for i in range(N)]
    M = payload_M
    b = payload_b
    for rod in rods:
        M = M + rod.m * (rod.wrench @ rod.wrench.T)
        b = b - rod.m * rod.along * rod.wrench
    solved = solve_positive_definite(M, b)
    acceleration = solved if given is None else given
    a0, omega0_dot = acceleration[:3], acceleration[3:]

    derivative = [
        R0 @ v0,
        a0 - ca.cross(omega0, v0),
        euler_rates(x[state.THETA0]) @ omega0,
        omega0_dot,
    ]
    tensions = []
    unbalanced = payload_b - payload_M @ acceleration
    for i, rod in enumerate(rods):
        derivative += _uav_derivative(symbols, i, rod, acceleration)
        tension = rod.m * (rod.along + ca.dot(rod.wrench, acceleration))
        tensions.append(tension)
        unbalanced = unbalanced - tension * rod.wrench
    return Motion(
        derivative=ca.vertcat(*derivative),
        tensions=ca.vertcat(*tensions),
        acceleration=solved,
        mass=M,
        unbalanced=unbalanced,
    )


def _rod(symbols: Symbols, i: int, R0: ca.SX, g_P: ca.SX) -> _Rod:
    """Return a UAV and its rod, 0-based: s = g - f/m R0' R_i b3 + R0' F_i / m, (8)-(10), (37)."""
    m, _, rho, length = symbols.uav(i)
    omega0 = symbols.x[state.OMEGA0]
    block = symbols.x[state.uav_slice(i)]
    e, Omega = block[state.E], block[state.ROD_RATE]
    thrust = symbols.u[state.INPUTS * i]

    # Specific force without rod: gravity, lift along -b3 of the body, external force.
    lift = thrust / m * (R0.T @ rotation(block[state.THETA])[:, 2])
    s_P = g_P - lift + R0.T @ symbols.force(i + 1) / m
    centripetal = ca.cross(omega0, ca.cross(omega0, rho))
    return _Rod(
        m=m,
        rho=rho,
        length=length,
        e=e,
        Omega=Omega,
        s_P=s_P,
        centripetal=centripetal,
        along=ca.dot(e, centripetal - s_P) + length * ca.dot(Omega, Omega),
        wrench=ca.vertcat(e, ca.cross(rho, e)),
    )


def _uav_derivative(symbols: Symbols, i: int, rod: _Rod, acceleration: ca.SX) -> list[ca.SX]:
    """Return the derivatives of a UAV's states: rod, rod rate, attitude and body rates.

    e' = (Omega - omega0) x e,  Omega' = e x (a_attachment - s) / l - omega0 x Omega,
    omega' = J^-1 (tau - omega x J omega), or by the inner loop K (command - omega)
    Source: docs/equations.md (5), (6), (12), (13), (57).
    """
    J = symbols.uav(i)[1]
    omega0 = symbols.x[state.OMEGA0]
    block = symbols.x[state.uav_slice(i)]
    omega = block[state.OMEGA]
    command = symbols.u[state.INPUTS * i + 1 : state.INPUTS * (i + 1)]

    attachment = acceleration[:3] + ca.cross(acceleration[3:], rod.rho) + rod.centripetal
    Omega_dot = ca.cross(rod.e, attachment - rod.s_P) / rod.length - ca.cross(omega0, rod.Omega)
    if symbols.rates:
        # K of the inner loops follows the parameters of the bodies, (3,), 1/s.
        gains = symbols.p[8 + 11 * symbols.N :]
        omega_dot = gains * (command - omega)
    else:
        omega_dot = solve_positive_definite(J, command - ca.cross(omega, J @ omega))
    return [
        ca.cross(rod.Omega - omega0, rod.e),
        Omega_dot,
        euler_rates(block[state.THETA]) @ omega,
        omega_dot,
    ]


def uav_positions(symbols: Symbols) -> list[ca.SX]:
    """Return r_i = r0 + R0 (rho_i - l_i e_i) for each UAV, (3,), inertial frame, m.

    Source: paper (1).
    """
    x, R0 = symbols.x, rotation(symbols.x[state.THETA0])
    bodies = [(x[state.uav_slice(i)][state.E], *symbols.uav(i)) for i in range(symbols.N)]
    return [x[state.R0] + R0 @ (rho - length * e) for e, _, _, rho, length in bodies]


def velocities(symbols: Symbols) -> ca.SX:
    """Return the velocities of the centres of mass, (1 + N, 3), inertial frame, m/s.

    Source: docs/equations.md (39).
    """
    x = symbols.x
    R0, v0, omega0 = rotation(x[state.THETA0]), x[state.V0], x[state.OMEGA0]
    rows: list[ca.SX] = [(R0 @ v0).T]
    for i in range(symbols.N):
        _, _, rho, length = symbols.uav(i)
        block = x[state.uav_slice(i)]
        swing = length * ca.cross(block[state.ROD_RATE], block[state.E])
        rows.append((R0 @ (v0 + ca.cross(omega0, rho) - swing)).T)
    return ca.vertcat(*rows)


def outputs(symbols: Symbols) -> ca.SX:
    """Return y = h(x) = [r_1..r_N, Theta_0, yaw rates of UAVs, r_0, r_0'], (4 N + 9), SI, inertial: paper (12)."""
    x = symbols.x
    yaw_rates = [x[state.uav_slice(i)][state.OMEGA][2] for i in range(symbols.N)]
    payload = [x[state.R0], rotation(x[state.THETA0]) @ x[state.V0]]
    return ca.vertcat(*uav_positions(symbols), x[state.THETA0], *yaw_rates, *payload)


def sensed(symbols: Symbols, tensions: ca.SX) -> ca.SX:
    """Return what the UAVs' own sensors measure under tensions, (15 N,), as in `model.state`.

    Equations.md (61).
    """
    x, velocity, found = symbols.x, velocities(symbols), list[ca.SX]()
    R0 = rotation(x[state.THETA0])
    for i, position in enumerate(uav_positions(symbols)):
        block, m = x[state.uav_slice(i)], symbols.uav(i)[0]
        pull = R0 @ block[state.E] * tensions[i] + symbols.force(i + 1)
        lift = ca.vertcat(0.0, 0.0, symbols.u[state.INPUTS * i])
        force = (rotation(block[state.THETA]).T @ pull - lift) / m
        found += [position, velocity[i + 1, :].T, block[state.THETA], block[state.OMEGA], force]
    return ca.vertcat(*found)


def project(x: ca.SX, N: int) -> ca.SX:
    """Return the state with the rods projected back onto |e_i| = 1 and e_i . Omega_i = 0."""
    parts = [x[: state.PAYLOAD]]
    for i in range(N):
        block = x[state.uav_slice(i)]
        e = block[state.E] / ca.norm_2(block[state.E])
        Omega = block[state.ROD_RATE]
        parts += [e, Omega - e * ca.dot(e, Omega), block[state.THETA], block[state.OMEGA]]
    return ca.vertcat(*parts)


def projection(x: ca.SX, N: int) -> ca.SX:
    """Return the derivative of `project` on the manifold, (n, n), sparse.

    Source: docs/equations.md (15a).
    """
    parts = [ca.SX.eye(state.PAYLOAD)]
    for i in range(N):
        block = x[state.uav_slice(i)]
        e, Omega = block[state.E], block[state.ROD_RATE]
        across = ca.SX.eye(3) - e @ e.T
        rod = ca.vertcat(ca.horzcat(across, ca.SX(3, 3)), ca.horzcat(-e @ Omega.T, across))
        parts += [rod, ca.SX.eye(state.PER_UAV - 6)]
    return ca.diagcat(*parts)


def _symmetric(upper: ca.SX) -> ca.SX:
    xx, xy, xz, yy, yz, zz = ca.vertsplit(upper)
    return ca.vertcat(ca.horzcat(xx, xy, xz), ca.horzcat(xy, yy, yz), ca.horzcat(xz, yz, zz))


def solve_positive_definite(M: ca.SX, b: ca.SX) -> ca.SX:
    """Return M^-1 b, (size, columns), by an unrolled L D L^T factorisation.

    Short, exact derivatives.
    """
    size = M.shape[0]
    L = [[ca.SX(0)] * size for _ in range(size)]
    D: list[ca.SX] = []
    for j in range(size):
        D.append(M[j, j] - sum(L[j][k] ** 2 * D[k] for k in range(j)))
        for i in range(j + 1, size):
            L[i][j] = (M[i, j] - sum(L[i][k] * L[j][k] * D[k] for k in range(j))) / D[j]
    z: list[ca.SX] = []
    for i in range(size):
        z.append(b[i, :] - sum(L[i][k] * z[k] for k in range(i)))
    solution: list[ca.SX] = [ca.SX(0)] * size
    for i in reversed(range(size)):
        solution[i] = z[i] / D[i] - sum(L[k][i] * solution[k] for k in range(i + 1, size))
    return ca.vertcat(*solution)
